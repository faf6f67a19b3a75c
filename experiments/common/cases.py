"""An analysis: what was trained on some levels is asked to plan on others, in several ways.

Each way of asking is a row beside the paper's number. What must be trained is what
`experiments.babyai` would train, in the same folder, and is trained once.
"""

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from leapjax import checkpoints, files, pretrained, rollouts
from leapjax.batching import compile_planner
from leapjax.configuration import AnyConfig, hash_config
from leapjax.data import seeds, windows
from leapjax.data.seeds import UNSEEN
from leapjax.domain import Domain
from leapjax.domains import find_domain
from leapjax.energy import view
from leapjax.environments import Adapter
from leapjax.errors import UserError, did_you_mean
from leapjax.planners import CrossEntropyConfig, GibbsConfig, PlannerConfig, ShootingConfig
from leapjax.presets import find_preset
from leapjax.pretrained import Pretrained
from leapjax.rollouts import Episodes
from leapjax.running import jax_setup, limits, results, shell
from leapjax.running.data import load_demonstrations
from leapjax.running.interruption import Interruption
from leapjax.running.limits import check_counts
from leapjax.running.metrics import read_metrics
from leapjax.running.programs import PLANS_TOGETHER
from leapjax.running.results import Row
from leapjax.running.run import Experiment, find_folder, open_run
from leapjax.running.train import train
from leapjax.serialization import find_differences
from leapjax.types import Energy

Change = Callable[[AnyConfig], AnyConfig]


def keep_config(config: AnyConfig) -> AnyConfig:
    """Returns a configuration as it is."""
    return config


class Model(NamedTuple):
    """A model that a case needs.

    Attributes:
        level: that it is trained on.
        change: of its method's configuration, where the preset is `leapjax`.
    """

    level: str
    change: Change = keep_config


def alone(energies: Sequence[Energy]) -> Energy:
    """What the one model of a case says."""
    return energies[0]


class Way(NamedTuple):
    """A way to ask what was trained for plans."""

    name: str
    method: str = "leap"
    minimise: Callable[[Sequence[Energy]], Energy] = alone
    # (energies of the case's models) -> what the planner minimises; see `describe_function`
    search: Callable[[Any], PlannerConfig] = lambda trained: trained
    # (settings that it was trained with) -> settings of how it searches
    executed: int | None = None  # actions before replanning; None: all
    paper: float | None = None  # the paper's success, in percent
    remembers: bool = False  # may look at the whole episode; its models see no more than they do
    explores: bool = False  # coming back costs: beyond what the paper asks for


def draw_at(temperature: float) -> Callable[[Any], PlannerConfig]:
    """The search of a way: as trained, but for the temperature that actions are drawn at."""
    return lambda trained: dataclasses.replace(trained, temperature=temperature)


# Who takes the likeliest of single actions walks to and fro, and noise leads out of it.
NOISE = draw_at(4.0)


class Case(NamedTuple):
    """Models, and the level that they are asked to plan on."""

    name: str
    models: Sequence[Model]
    level: str
    ways: Sequence[Way]
    adapter: Callable[[str], Adapter] | None = None
    # (level) -> adapter; rows sum its `violations`; see `describe_function`


class Analysis(NamedTuple):
    """The cases of one program."""

    name: str  # of its module, and of its file of rows
    cases: Sequence[Case]
    domain: str = "babyai"
    timed: bool = False  # what a plan costs is part of the comparison: take it on an idle machine
    change: Change = keep_config  # of every model's configuration, for tests


@dataclasses.dataclass(frozen=True)
class Options:
    """Train models, plan with each in several ways, and print success beside the paper's.

    Attributes:
        only: Cases to do, by name; all of them if none is given.
        methods: Methods to do; all that a case has if none is given.
        ways: Ways to plan, by name; all that a case has if none is given.
        preset: Preset that models are trained with: "leapjax" for ours, "paper" for the paper's.
        seeds: Training seeds.
        episodes: Held-out episodes to measure success on, for each row.
        test_seed: Level seed of the first of these episodes.
        validation: Measure success on validation levels instead, to choose settings.
        record: Append rows to results/, which is committed, and skip what is recorded already.
        force: With `--record`: do again what is recorded, and replace its rows.
        runs: Folder for trained models and unrecorded rows.
    """

    only: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    ways: tuple[str, ...] = ()
    preset: str = "leapjax"
    seeds: tuple[int, ...] = (0,)
    episodes: int = 200
    test_seed: int = UNSEEN
    validation: bool = False
    record: bool = False
    force: bool = False
    runs: Path = Path("runs")

    @property
    def played(self) -> range:
        """The level seeds of the episodes."""
        first = seeds.validation_seeds if self.validation else seeds.test_seeds
        return first(self.test_seed, self.episodes)


def main(analysis: Analysis, arguments: Sequence[str] | None = None) -> int:
    """Trains what is missing and does every way of every case; the exit code."""
    given = shell.read_arguments(arguments)
    module = f"experiments.{analysis.name}"
    about = f"{inspect.getdoc(Options)}".partition("\n\n")[0]
    about += f"\n\nThe cases: {_join_names(analysis.cases)}."
    options = shell.parse(Options, module, given, description=about)
    return shell.run_interruptible_program(
        module,
        given,
        lambda interruption: run_all(analysis, options, interruption),
    )


class Work(NamedTuple):
    """What every step of an analysis needs."""

    analysis: Analysis
    options: Options
    versions: dict[str, str]  # of the code that runs, whatever is committed meanwhile
    console: Console
    interruption: Interruption

    @property
    def rows(self) -> Path:
        """The file of its rows."""
        folder = results.choose_folder(self.options.record, self.options.runs)
        return folder / f"{self.analysis.name}.jsonl"


def run_all(analysis: Analysis, options: Options, interruption: Interruption) -> None:
    """Every case, method and seed asked for, and their table."""
    wanted = choose_cases(analysis, options)
    jax_setup.start()
    versions = results.find_versions()
    work = Work(analysis, options, versions, Console(markup=False), interruption)
    for where in (work.rows.parent, options.runs):  # not after hours of work
        files.check_writable(where)
    rows: list[Row] = []
    for case in wanted:
        for method in list_methods(case):
            for seed in options.seeds:
                rows += run_case(work, case, method, seed)
    work.console.print(make_table(rows))


def choose_cases(analysis: Analysis, options: Options) -> list[Case]:
    """The cases that are asked for.

    Raises:
        UserError: an unknown case, method or preset, or options that cannot be.
    """
    check_counts(options, "episodes")
    len(options.played)  # raises where their seeds leave their range
    limits.check_seeds(options.seeds)
    known = [case.name for case in analysis.cases]
    for name in options.only:
        if name not in known:
            expected = f"expected some of {', '.join(known)}"
            raise UserError(f"unknown case {name!r}: {expected}{did_you_mean(name, known)}")
    wanted = [case for case in analysis.cases if not options.only or case.name in options.only]
    ways = [way for case in wanted for way in case.ways]
    for option, given, possible in (
        ("methods", options.methods, {way.method for way in ways}),
        ("ways", options.ways, {way.name for way in ways}),
    ):
        for name in given:
            if name not in possible:
                expected = ", ".join(sorted(possible))
                raise UserError(f"--{option} {name}: expected some of {expected}")
    wanted = [case._replace(ways=select_ways(case, options)) for case in wanted]
    if not any(case.ways for case in wanted):
        raise UserError("--methods, --ways: none of these ways is of one of these methods")
    for case in wanted:
        for method in list_methods(case):
            for seed in options.seeds:
                for config in make_configs(analysis, case, method, seed, options):
                    limits.check(config)
    return wanted


def _join_names(cases: Sequence[Case]) -> str:
    return ", ".join(case.name for case in cases)


def select_ways(case: Case, options: Options) -> list[Way]:
    """The ways of a case that are asked for."""
    return [
        way
        for way in case.ways
        if (not options.methods or way.method in options.methods)
        and (not options.ways or way.name in options.ways)
    ]


def list_methods(case: Case) -> list[str]:
    """The methods that a case has ways of, in their order."""
    return list(dict.fromkeys(way.method for way in case.ways))


def make_training_config(
    analysis: Analysis, model: Model, method: str, seed: int, options: Options
) -> AnyConfig:
    """The configuration of a run of `experiments.babyai` that trains a model."""
    config = find_preset(analysis.domain, model.level, method, options.preset)
    if options.preset == "leapjax":
        config = model.change(config)
    config = analysis.change(config)
    return dataclasses.replace(config, seeds=(seed,), runs=options.runs, pictures=False)


def make_configs(
    analysis: Analysis, case: Case, method: str, seed: int, options: Options
) -> list[AnyConfig]:
    """What each of a case's models is trained with, of one method."""
    return [make_training_config(analysis, model, method, seed, options) for model in case.models]


def run_case(work: Work, case: Case, method: str, seed: int) -> list[Row]:
    """The rows of one case, method and training seed."""
    analysis, options = work.analysis, work.options
    settings = make_configs(analysis, case, method, seed, options)
    ways = {
        hash_row(analysis, case, way, settings, seed, options): way
        for way in case.ways
        if way.method == method
    }
    # Read even where nothing is looked for: a damaged file is better found now than later.
    found = {row["hash"]: row for row in results.read(work.rows)}
    rows = found if options.record and not options.force else {}
    missing = [name for name in ways if name not in rows]
    models = load_models(work, case, method, seed) if missing else []
    for name in missing:
        # A sum of models may have one of them twice.
        seconds = sum(
            map(read_training_seconds, {find_run_folder(each, seed) for each in settings})
        )
        said, episodes = play(case, ways[name], models, seed, options, work.interruption)
        row = {
            "experiment": analysis.name,
            "hash": name,
            "domain": analysis.domain,
            "trained": [hash_config(each, seed) for each in settings],
            "train_seconds": round(seconds, 3),
            "versions": work.versions,
            **said,
        }
        results.record(work.rows, row, episodes)
        rows[name] = row
    for name, way in ways.items():
        before = "" if name in missing else ", recorded already"
        line = f"{case.name}, {way.name}: {results.format_rate(rows[name])}{before}"
        work.console.print(line, highlight=False)
    return [rows[name] for name in ways]


def hash_row(
    analysis: Analysis,
    case: Case,
    way: Way,
    settings: Sequence[AnyConfig],
    seed: int,
    options: Options,
) -> str:
    """Twelve hexadecimal digits that name a row: what was trained, how it plans, and where.

    Of the planner, and of what is asked for, what differs from the defaults alone, so that a
    setting that is added later changes no name.
    """
    search = way.search(settings[0].planner)
    planner = find_differences(dataclasses.asdict(search), dataclasses.asdict(type(search)()))
    asked = {
        "minimise": describe_function(way.minimise), "remembers": way.remembers,
        "adapter": describe_function(case.adapter),
    }  # fmt: skip
    plain = {"minimise": describe_function(alone), "remembers": False, "adapter": None}
    named = {
        "experiment": analysis.name, "case": case.name, "way": way.name, "method": way.method,
        "level": case.level, "seed": seed, "executed": way.executed,
        "episodes": options.episodes, "first": options.played[0],
        "planner": {"kind": type(search).__name__, **planner},
        "trained": [hash_config(each, seed) for each in settings],
        **find_differences(asked, plain),
    }  # fmt: skip
    return hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()[:12]


def describe_function(what: Any) -> Any:
    """Returns a function's name, and the values that `functools.partial` binds, for JSON.

    The hashes of recorded rows hold these names: a function that has rows keeps its name.
    """
    if isinstance(what, functools.partial):
        bound = {name: describe_function(each) for name, each in what.keywords.items()}
        return [describe_function(what.func), *map(describe_function, what.args), bound]
    if isinstance(what, tuple):
        return [describe_function(each) for each in what]
    return what.__qualname__ if callable(what) else what


def load_models(work: Work, case: Case, method: str, seed: int) -> list[Pretrained]:
    """The models of a case, of one method, trained where they are not there yet."""
    wanted = make_configs(work.analysis, case, method, seed, work.options)
    return [load_or_train(work, config, seed) for config in wanted]


def make_experiment(config: AnyConfig) -> Experiment:
    """The program whose runs are used, or made."""
    return Experiment(config.domain, config.domain)


def find_run_folder(config: AnyConfig, seed: int) -> Path:
    """Where a model is, or will be."""
    return find_folder(make_experiment(config), config, seed)


def read_training_seconds(folder: Path) -> float:
    """How long the training of a run has taken, stops and continuations included."""
    metrics = read_metrics(folder)
    return metrics[-1]["seconds"] if metrics else 0.0


def load_or_train(work: Work, config: AnyConfig, seed: int) -> Pretrained:
    """A model, trained where it is not there yet."""
    training, folder = make_experiment(config), find_run_folder(config, seed)
    # Metrics are written before the checkpoint that belongs to them: a kill may be in between.
    if (folder / pretrained.CHECKPOINTS / str(config.training.steps)).is_dir():
        with contextlib.suppress(checkpoints.Unfinished):  # damaged: the end is learned again
            return pretrained.load(folder, chunk_sizes=(PLANS_TOGETHER,), finished=True)
    work.console.print(f"training {folder}", highlight=False)
    opened = open_run(
        training, config, seed, work.console, work.interruption, work.options.played, plays=False
    )
    with opened as run:
        return train(run, load_demonstrations(run))


def make_played_domain(level: str, models: Sequence[Pretrained]) -> Domain:
    """A level that models are asked to plan on."""
    specification = models[0].specification
    return find_domain(specification.domain).make(level, specification.domain_settings)


def make_planner(
    domain: Domain, way: Way, models: Sequence[Pretrained], search: PlannerConfig
) -> Pretrained:
    """The models of a case as one planner for a level, which minimises what a way says."""
    specification = models[0].specification
    energies = [model.energy for model in models]
    if way.remembers:
        recent = functools.partial(windows.recent, length=specification.context)
        energies = [view(energy, recent) for energy in energies]
        specification = dataclasses.replace(specification, context=domain.max_steps)
    energy = way.minimise(energies)
    params = models[0].params if len(models) == 1 else tuple(model.params for model in models)
    # What weighs many plans of a context at once has a full batch with few contexts.
    weighs_many = isinstance(search, ShootingConfig | CrossEntropyConfig)
    plan = compile_planner(energy, search, (1, 2) if weighs_many else (PLANS_TOGETHER,))
    return Pretrained(specification, energy, params, plan, domain)


def play(
    case: Case,
    way: Way,
    models: Sequence[Pretrained],
    seed: int,
    options: Options,
    interruption: Interruption,
) -> tuple[Row, Episodes]:
    """What one way of asking gives, and its episodes."""
    specification = models[0].specification
    search = way.search(specification.planner)
    domain = make_played_domain(case.level, models)
    adapters: list[Adapter] = []
    compile_seconds = 0.0

    def make_adapter() -> Adapter:
        adapters.append(case.adapter(case.level) if case.adapter else domain.make_adapter())
        return adapters[-1]

    def episodes(config: PlannerConfig) -> Episodes:
        nonlocal compile_seconds
        planner = make_planner(domain, way, models, config)
        begun = time.perf_counter()
        planner.compile(options.episodes, way.executed)
        compile_seconds += time.perf_counter() - begun
        adapters.clear()
        return rollouts.evaluate(
            make_adapter, options.played, planner.plan, planner.params,
            context=planner.specification.context, seed=seed, executed=way.executed,
            progress=lambda over, good: interruption.check(),
        )  # fmt: skip

    first_pass = None
    if isinstance(search, GibbsConfig) and search.horizon > 1:
        one = dataclasses.replace(search, iterations=1, fill="together", restarts=1)
        first_pass = int(episodes(one).successes.sum())
    found = episodes(search)
    violations = [adapter.violations for adapter in adapters if hasattr(adapter, "violations")]
    good = found.lengths[found.successes]
    row = {
        "level": case.level,
        "case": case.name,
        "way": way.name,
        "method": way.method,
        "preset": options.preset,
        "seed": seed,
        "episodes": options.episodes,
        "first_episode_seed": options.played[0],
        "validation": options.validation,
        "successes": int(found.successes.sum()),
        "success": float(found.successes.mean()),
        "first_pass_successes": first_pass,
        "violations": sum(violations) if violations else None,
        "mean_length": float(found.lengths.mean()),
        "mean_success_length": float(good.mean()) if len(good) else None,
        "planner": {"kind": type(search).__name__, **dataclasses.asdict(search)},
        "executed": way.executed or search.horizon,
        "compile_seconds": round(compile_seconds, 3),
        "eval_seconds": round(found.seconds, 3),
        "plans": found.plans,
        "plans_per_second": found.plans / found.planning_seconds,
        "paper_success": way.paper,
        "date": results.format_date(),
    }
    return row, found


def select_rows(
    analysis: Analysis, rows: Sequence[Row], case: Case, way: Way, preset: str
) -> list[Row]:
    """The rows of a way to plan as it is today, one for each training seed."""
    found = []
    for row in rows:
        if (row["case"], row["way"], row["preset"]) != (case.name, way.name, preset):
            continue
        options = Options(preset=preset)
        settings = make_configs(analysis, case, way.method, row["seed"], options)
        if row["hash"] == hash_row(analysis, case, way, settings, row["seed"], options):
            found.append(row)
    return found


def make_table(rows: Sequence[Row]) -> Table:
    """The rows for a terminal; below, the mean over training seeds if there are several."""
    shown = Table("case", "way", "method", "seed", "N = 1", "success [95%]", "ms per plan", "paper")

    def named(row: Row) -> tuple[str, ...]:
        return row["case"], row["way"], f"{row['method']} ({row['preset']})"

    def paper(row: Row) -> str:
        found = row["paper_success"]
        return "-" if found is None else f"{found:.1f}%"

    for row in rows:
        first = row["first_pass_successes"]
        shown.add_row(
            *named(row),
            str(row["seed"]),
            "" if first is None else f"{first / row['episodes']:.1%}",
            results.format_rate(row),
            f"{1e3 / row['plans_per_second']:.2f}",
            paper(row),
        )
    shown.add_section()
    for group in results.group_seeds(rows, named):
        mean = results.format_rate_over_seeds(group)
        shown.add_row(*named(group[0]), f"mean of {len(group)}", "", mean, "", paper(group[0]))
    return shown
