"""Analyses: models trained on some levels plan on other levels, in several ways.

Each way makes a row, beside the paper's number. Models are trained once, in the run folders of
`experiments.babyai`.
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
from typing import Any, NamedTuple, Protocol

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
        level: level that it is trained on.
        change: changes the method's configuration, with preset `leapjax` only.
    """

    level: str
    change: Change = keep_config


def alone(energies: Sequence[Energy]) -> Energy:
    """Returns the energy of a case's only model."""
    return energies[0]


class Way(NamedTuple):
    """A way to plan with the models of a case.

    Attributes:
        name: names its rows.
        method: method of the models.
        minimise: (energies of the case's models) -> energy to minimise; see `describe_function`.
        search: (trained planner's configuration) -> configuration of the search.
        executed: actions before replanning; `None` executes whole plans.
        paper: the paper's success, in percent.
        remembers: whether penalties see the whole episode; models still see their K steps.
    """

    name: str
    method: str = "leap"
    minimise: Callable[[Sequence[Energy]], Energy] = alone
    search: Callable[[Any], PlannerConfig] = lambda trained: trained
    executed: int | None = None
    paper: float | None = None
    remembers: bool = False


def draw_at(temperature: float) -> Callable[[Any], PlannerConfig]:
    """Makes a `Way.search` that changes only the temperature."""
    return lambda trained: dataclasses.replace(trained, temperature=temperature)


# An agent that always takes the likeliest single action may walk to and fro; noise breaks this up.
NOISE = draw_at(4.0)


class CountingAdapter(Adapter, Protocol):
    """An adapter that counts violations of constraints, over all its episodes."""

    violations: int


class Case(NamedTuple):
    """Models, and the level that they plan on.

    Attributes:
        name: names its rows.
        models: the models.
        level: level to play.
        ways: ways to plan.
        adapter: (level) -> adapter that counts violations; by default the level's own adapter. See
            `describe_function`.
    """

    name: str
    models: Sequence[Model]
    level: str
    ways: Sequence[Way]
    adapter: Callable[[str], CountingAdapter] | None = None


class Analysis(NamedTuple):
    """The cases of one program.

    Attributes:
        name: names its module, and its file of rows.
        cases: the cases.
        domain: domain of all levels.
        change: changes the configuration of every model, for tests.
    """

    name: str
    cases: Sequence[Case]
    domain: str = "babyai"
    change: Change = keep_config


@dataclasses.dataclass(frozen=True)
class Options:
    """Train models, plan with each in several ways, and print success beside the paper's.

    Attributes:
        only: Names of the cases to run, by default all.
        methods: Methods to run, by default all methods of a case.
        ways: Names of the ways to plan, by default all ways of a case.
        preset: Preset that models are trained with: "leapjax" for ours, "paper" for the paper's.
        seeds: Training seeds.
        episodes: Held-out episodes to measure success on, for each row.
        test_seed: Level seed of the first of these episodes.
        validation: Measure success on validation levels instead, to choose settings.
        record: Append rows to results/, which is committed, and skip rows that are recorded.
        force: With `--record`: measure recorded rows again, and replace them.
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
        """Level seeds of the episodes."""
        first = seeds.validation_seeds if self.validation else seeds.test_seeds
        return first(self.test_seed, self.episodes)


def main(analysis: Analysis, arguments: Sequence[str] | None = None) -> int:
    """Trains missing models and measures every chosen way; returns the exit code."""
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
    """Values that every step of an analysis needs.

    Attributes:
        analysis: the analysis.
        options: options of its command line.
        versions: versions at the start; commits made meanwhile do not change them.
        console: console for messages.
        interruption: interruption of the program.
    """

    analysis: Analysis
    options: Options
    versions: dict[str, str]
    console: Console
    interruption: Interruption

    @property
    def rows(self) -> Path:
        """Path of the file of rows."""
        folder = results.choose_folder(self.options.record, self.options.runs)
        return folder / f"{self.analysis.name}.jsonl"


def run_all(analysis: Analysis, options: Options, interruption: Interruption) -> None:
    """Runs every chosen case, method and seed, and prints their table."""
    wanted = choose_cases(analysis, options)
    jax_setup.start()
    versions = results.find_versions()
    work = Work(analysis, options, versions, Console(markup=False), interruption)
    for where in (work.rows.parent, options.runs):  # fails before hours of work
        files.check_writable(where)
    rows: list[Row] = []
    for case in wanted:
        for method in list_methods(case):
            for seed in options.seeds:
                rows += run_case(work, case, method, seed)
    work.console.print(make_table(rows))


def choose_cases(analysis: Analysis, options: Options) -> list[Case]:
    """Returns the cases that the options choose, with the chosen ways.

    Raises:
        UserError: a case, method, way or preset is unknown, or an option is out of range.
    """
    check_counts(options, "episodes")
    len(options.played)  # raises if a seed is out of range
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
    """Returns the ways of a case that the options choose."""
    return [
        way
        for way in case.ways
        if (not options.methods or way.method in options.methods)
        and (not options.ways or way.name in options.ways)
    ]


def list_methods(case: Case) -> list[str]:
    """Lists the methods of a case's ways, in their order."""
    return list(dict.fromkeys(way.method for way in case.ways))


def make_training_config(
    analysis: Analysis, model: Model, method: str, seed: int, options: Options
) -> AnyConfig:
    """Makes the configuration of a run of `experiments.babyai` that trains a model."""
    config = find_preset(analysis.domain, model.level, method, options.preset)
    if options.preset == "leapjax":
        config = model.change(config)
    config = analysis.change(config)
    return dataclasses.replace(config, seeds=(seed,), runs=options.runs, pictures=False)


def make_configs(
    analysis: Analysis, case: Case, method: str, seed: int, options: Options
) -> list[AnyConfig]:
    """Makes the training configurations of a case's models, with one method."""
    return [make_training_config(analysis, model, method, seed, options) for model in case.models]


def run_case(work: Work, case: Case, method: str, seed: int) -> list[Row]:
    """Returns the rows of one case, method and training seed; measures missing rows."""
    analysis, options = work.analysis, work.options
    settings = make_configs(analysis, case, method, seed, options)
    ways = {
        hash_row(analysis, case, way, settings, seed, options): way
        for way in case.ways
        if way.method == method
    }
    # Reads the file in any case, so that a damaged file ends the program before long work.
    found = {row["hash"]: row for row in results.read(work.rows)}
    rows = found if options.record and not options.force else {}
    missing = [name for name in ways if name not in rows]
    models = load_models(work, case, method, seed) if missing else []
    for name in missing:
        # A set, because a sum of models may hold a model twice.
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
    """Hashes the trainings, the way to plan and the episodes of a row to 12 hexadecimal digits.

    The planner's settings, `minimise`, `remembers` and `adapter` count only if they differ from
    their defaults, so a setting that is added later changes no hash.
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
    """Loads the models of a case, with one method; trains missing models."""
    wanted = make_configs(work.analysis, case, method, seed, work.options)
    return [load_or_train(work, config, seed) for config in wanted]


def make_experiment(config: AnyConfig) -> Experiment:
    """Returns the program that would train with a configuration."""
    return Experiment(config.domain, config.domain)


def find_run_folder(config: AnyConfig, seed: int) -> Path:
    """Returns the folder of a model, which may not exist yet."""
    return find_folder(make_experiment(config), config, seed)


def read_training_seconds(folder: Path) -> float:
    """Reads how many seconds the training of a run took, over all its continuations."""
    metrics = read_metrics(folder)
    return metrics[-1]["seconds"] if metrics else 0.0


def load_or_train(work: Work, config: AnyConfig, seed: int) -> Pretrained:
    """Loads a model, or trains it if it is missing."""
    training, folder = make_experiment(config), find_run_folder(config, seed)
    # Looks for the checkpoint, not for metrics, which a killed run may have without it.
    if (folder / pretrained.CHECKPOINTS / str(config.training.steps)).is_dir():
        with contextlib.suppress(checkpoints.Unfinished):  # damaged: trains its last steps again
            return pretrained.load(folder, chunk_sizes=(PLANS_TOGETHER,), finished=True)
    work.console.print(f"training {folder}", highlight=False)
    opened = open_run(
        training, config, seed, work.console, work.interruption, work.options.played, plays=False
    )
    with opened as run:
        return train(run, load_demonstrations(run))


def make_played_domain(level: str, models: Sequence[Pretrained]) -> Domain:
    """Makes the level that models plan on."""
    specification = models[0].specification
    return find_domain(specification.domain).make(level, specification.domain_settings)


def make_planner(
    domain: Domain, way: Way, models: Sequence[Pretrained], search: PlannerConfig
) -> Pretrained:
    """Makes one planner from the models of a case, with the energy of a way."""
    specification = models[0].specification
    energies = [model.energy for model in models]
    if way.remembers:
        recent = functools.partial(windows.recent, length=specification.context)
        energies = [view(energy, recent) for energy in energies]
        specification = dataclasses.replace(specification, context=domain.max_steps)
    energy = way.minimise(energies)
    params = models[0].params if len(models) == 1 else tuple(model.params for model in models)
    # A planner that scores many candidates per context fills a batch with few contexts.
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
    """Plays the episodes of one way; returns its measurements and the episodes."""
    specification = models[0].specification
    search = way.search(specification.planner)
    domain = make_played_domain(case.level, models)
    counting: list[CountingAdapter] = []
    compile_seconds = 0.0

    def make_adapter() -> Adapter:
        if case.adapter is None:
            return domain.make_adapter()
        counting.append(case.adapter(case.level))
        return counting[-1]

    def episodes(config: PlannerConfig) -> Episodes:
        nonlocal compile_seconds
        planner = make_planner(domain, way, models, config)
        begun = time.perf_counter()
        planner.compile(options.episodes, way.executed)
        compile_seconds += time.perf_counter() - begun
        counting.clear()
        return rollouts.evaluate(
            make_adapter, options.played, planner.plan, planner.params,
            context=planner.specification.context, seed=seed, executed=way.executed,
            progress=lambda over, good: interruption.check(),
        )  # fmt: skip

    first_pass = None
    if isinstance(search, GibbsConfig) and search.horizon > 1:
        one = GibbsConfig(search.horizon, 1, temperature=search.temperature)
        first_pass = int(episodes(one).successes.sum())
    found = episodes(search)
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
        "violations": sum(each.violations for each in counting) if case.adapter else None,
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
    """Selects the rows of a way with today's settings, one for each training seed."""
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
    """Tabulates rows for a terminal; below them, means over training seeds if there are several."""
    shown = Table(
        *("case", "way", "method", "seed", "N = 1", "success [95%]", "ms per plan", "published")
    )

    def named(row: Row) -> tuple[str, ...]:
        return row["case"], row["way"], f"{row['method']} ({row['preset']})"

    def published(row: Row) -> str:
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
            published(row),
        )
    shown.add_section()
    for group in results.group_seeds(rows, named):
        mean = results.format_rate_over_seeds(group)
        shown.add_row(*named(group[0]), f"mean of {len(group)}", "", mean, "", published(group[0]))
    return shown
