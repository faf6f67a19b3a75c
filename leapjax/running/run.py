"""A run: a level, a method and a seed, with all that its steps share."""

import contextlib
import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from leapjax import files, processes
from leapjax.configuration import (
    AnyConfig,
    Config,
    configuration_hash,
    episode_seeds,
    make_domain,
    resolved,
    specify,
)
from leapjax.domain import Domain
from leapjax.pretrained import Pretrained, Specification
from leapjax.running import loggers, metrics, results
from leapjax.running.interruption import Interruption
from leapjax.running.loggers import About, Log
from leapjax.running.programs import BackgroundPrograms


def no_searches(config: AnyConfig) -> Sequence[AnyConfig]:
    """Returns no further ways to plan."""
    del config
    return ()


def no_numbers(level: str, method: str) -> float | None:
    """Returns None: nobody has published a success rate."""
    del level, method
    return None


class Experiment(NamedTuple):
    """What one program adds to the steps that all of them share.

    Attributes:
        name: of its module, and of its file of rows.
        domain: by name.
        searches: (configuration) -> how else to plan with what was trained, a row for each.
        animate: (planner, run, level seeds, path): draws plans being refined and executed.
        iterations: draw success against the number of iterations.
        config: `Config`, or a subclass: what its users call the options.
        paper: (level, method) -> the paper's success, in percent.
        package: of its module.
    """

    name: str
    domain: str
    searches: Callable[[AnyConfig], Sequence[AnyConfig]] = no_searches
    animate: "Callable[[Pretrained, Run, Sequence[int], Path], None] | None" = None
    iterations: bool = True
    config: type[AnyConfig] = Config
    paper: Callable[[str, str], float | None] = no_numbers
    package: str = "experiments"

    @property
    def module(self) -> str:
        """The module of its program."""
        return f"{self.package}.{self.name}"


@dataclasses.dataclass(frozen=True)
class Run:
    """What every step of a run needs.

    Attributes:
        experiment: that it is of.
        config: its configuration.
        domain: the level that is played.
        specification: of the planner that it makes.
        folder: where it leaves what it makes.
        played: level seeds of the episodes that measure success.
        console: for progress.
        interruption: asks it to stop.
        opened: closes what steps open, at the end of the run.
        plays: whether its planner will act; if not, nothing is compiled for that.
        log: takes measurements as they are made.
        programs: what it compiles.
        seconds: where the time went, filled in by each step.
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
        return configuration_hash(self.config, self.seed)

    @property
    def rows(self) -> Path:
        """The file that its row goes to."""
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
    """Opens a run of one level and one seed, with its loggers; closes all that its steps open.

    Args:
        experiment: that it is of.
        config: its configuration.
        seed: of the training.
        console: for progress.
        interruption: asks it to stop.
        played: level seeds that it may not learn from; None for those of the configuration.
        plays: whether its planner will act.
    """
    domain = make_domain(config)
    with contextlib.ExitStack() as opened:
        run = Run(
            experiment, config, domain, specify(config, seed, domain),
            find_folder(experiment, config, seed),
            episode_seeds(config) if played is None else played,
            console, interruption, opened, plays,
        )  # fmt: skip
        if processes.is_first():
            log = opened.enter_context(loggers.open_loggers(config.loggers, lambda: _describe(run)))
            run = dataclasses.replace(run, log=log)
        yield run


def _describe(run: Run) -> About:
    """What loggers are told of a run; makes its folder."""
    files.check_writable(run.folder)
    run.folder.mkdir(parents=True, exist_ok=True)
    before = metrics.read_metrics(run.folder)
    done = int(before[-1]["step"]) if before else 0
    return About(run.folder, run.name, resolved(run.config, run.seed), done)


def locate_rows(experiment: Experiment, config: AnyConfig) -> Path:
    """The file that rows go to."""
    return results.choose_folder(config.record, config.runs) / f"{experiment.name}.jsonl"


def find_folder(experiment: Experiment, config: AnyConfig, seed: int) -> Path:
    """Where a run leaves what it makes."""
    level = re.sub(r"[^\w.-]", "-", config.level)  # ids of environments may have a slash
    of = f"{level}-{config.method}-{config.preset}-seed{seed}"
    label = f"{experiment.name}-{of}-{configuration_hash(config, seed)}"
    return config.runs / ("evaluations" if config.checkpoint else "") / label
