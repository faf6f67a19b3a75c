"""A run: one level, one method and one seed, with the values that its steps share."""

import contextlib
import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from leapjax import files, processes
from leapjax.configuration import (
    AnyConfig,
    Config,
    choose_episode_seeds,
    hash_config,
    list_settings,
    make_domain,
    specify,
)
from leapjax.domain import Domain
from leapjax.pretrained import Pretrained, Specification
from leapjax.running import loggers, metrics, results
from leapjax.running.interruption import Interruption
from leapjax.running.loggers import About, Log
from leapjax.running.programs import BackgroundPrograms


class Experiment(NamedTuple):
    """The name and the functions of an experiment, by which its program differs from others.

    Attributes:
        name: name of its module and of its file of rows.
        domain: name of its domain.
        variants: (configuration) -> configurations of other searches or levels for the trained
            parameters; each makes a row. `None` if there are none.
        animate: (planner, run, level seeds, path); draws how plans are refined and executed.
        compare: (level, level seeds) -> table of solvers without learning, on the same levels.
        iterations: whether to draw success against the number of iterations.
        config: `Config`, or a subclass with the program's own names of options.
        paper: (level, method) -> the paper's success, in percent, or `None`. The field is `None` if
            the paper has no such experiment.
        package: package of its module; "" for a file of your own.
    """

    name: str
    domain: str
    variants: Callable[[AnyConfig], Sequence[AnyConfig]] | None = None
    animate: "Callable[[Pretrained, Run, Sequence[int], Path], None] | None" = None
    compare: Callable[[str, Sequence[int]], Table] | None = None
    iterations: bool = True
    config: type[AnyConfig] = Config
    paper: Callable[[str, str], float | None] | None = None
    package: str = "experiments"

    @property
    def module(self) -> str:
        """The module of the program."""
        return f"{self.package}.{self.name}".lstrip(".")


@dataclasses.dataclass(frozen=True)
class Run:
    """Values that the steps of a run share.

    Attributes:
        experiment: the experiment that the run belongs to.
        config: configuration of the run.
        domain: the level that is played.
        specification: specification of the planner that the run makes.
        folder: folder for checkpoints, metrics and pictures.
        played: level seeds of the episodes that measure success.
        console: prints progress.
        interruption: tells the run to stop.
        opened: collects what the steps open, and closes it at the end of the run.
        plays: whether the planner will play; if not, the run compiles no planner.
        log: receives measurements as they are made.
        programs: compiles the programs of the run in the background.
        seconds: seconds that each part of the run took; the steps fill it in.
    """

    experiment: Experiment
    config: AnyConfig
    domain: Domain
    specification: Specification
    folder: Path
    played: range
    console: Console
    interruption: Interruption
    opened: contextlib.ExitStack
    plays: bool = True
    log: Log = loggers.log_nothing
    programs: BackgroundPrograms = dataclasses.field(default_factory=BackgroundPrograms)
    seconds: dict[str, float] = dataclasses.field(
        default_factory=lambda: {"demos": 0.0, "compile": 0.0, "train": 0.0, "eval": 0.0}
    )

    @property
    def seed(self) -> int:
        """The training seed."""
        return self.specification.origin.seed

    @property
    def name(self) -> str:
        """The hash that names the run and its row."""
        return hash_config(self.config, self.seed)

    @property
    def rows(self) -> Path:
        """The file of the run's row."""
        return locate_rows(self.experiment, self.config)


@contextlib.contextmanager
def open_run(
    experiment: Experiment,
    config: AnyConfig,
    seed: int,
    console: Console,
    interruption: Interruption,
    played: range | None = None,
    plays: bool = True,
) -> Iterator[Run]:
    """Opens a run of one level and one seed, with its loggers; closes everything at the end.

    Args:
        experiment: the experiment that the run belongs to.
        config: configuration of the run.
        seed: training seed.
        console: prints progress.
        interruption: tells the run to stop.
        played: level seeds that the run may not learn from; `None` for the episodes that the
            configuration plays.
        plays: whether the planner will play.
    """
    domain = make_domain(config)
    with contextlib.ExitStack() as opened:
        run = Run(
            experiment, config, domain, specify(config, seed, domain),
            find_folder(experiment, config, seed),
            choose_episode_seeds(config) if played is None else played,
            console, interruption, opened, plays,
        )  # fmt: skip
        if processes.is_first():
            log = opened.enter_context(loggers.open_loggers(config.loggers, lambda: _describe(run)))
            run = dataclasses.replace(run, log=log)
        yield run


def _describe(run: Run) -> About:
    """Describes a run to its loggers; makes the folder of the run."""
    files.check_writable(run.folder)
    run.folder.mkdir(parents=True, exist_ok=True)
    before = metrics.read_metrics(run.folder)
    done = int(before[-1]["step"]) if before else 0
    return About(run.folder, run.name, list_settings(run.config, run.seed), done)


def locate_rows(experiment: Experiment, config: AnyConfig) -> Path:
    """Returns the file of an experiment's rows."""
    return results.choose_folder(config.record, config.runs) / f"{experiment.name}.jsonl"


def find_folder(experiment: Experiment, config: AnyConfig, seed: int) -> Path:
    """Returns the folder of a run, which need not exist."""
    level = re.sub(r"[^\w.-]", "-", config.level)  # ids of environments may have a slash
    of = f"{level}-{config.method}-{config.preset}-seed{seed}"
    label = f"{experiment.name}-{of}-{hash_config(config, seed)}"
    return config.runs / ("evaluations" if config.checkpoint else "") / label
