"""An experiment: levels of a domain, trained on and played, each a row beside the paper's."""

import contextlib
import dataclasses
import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
from rich.console import Console

from experiments.common import program, results, run, runtime
from experiments.common.config import episode_seeds, make_domain, parse, specify
from experiments.common.interruption import Interruption
from experiments.common.run import Run
from leapjax import files, processes, scores
from leapjax.configuration import AnyConfig, configuration_hash, resolved
from leapjax.data import seeds
from leapjax.errors import UserError
from leapjax.pretrained import Pretrained
from leapjax.rollouts import Episodes


class Experiment(NamedTuple):
    """What one experiment adds to the steps that all of them share."""

    name: str  # of its module, and of its file of rows
    domain: str
    searches: Callable[[AnyConfig], Sequence[AnyConfig]] = lambda config: ()
    # how else to plan with what was trained, a row for each
    animate: Callable[[Pretrained, Run, Sequence[int], Path], None] | None = None
    # (planner, run, level seeds, path): draws plans being refined and executed
    iterations: bool = True  # draw success against the number of iterations


def main(experiment: Experiment, arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    arguments = program.arguments_of(arguments)
    return program.stoppable(
        f"experiments.{experiment.name}",
        arguments,
        lambda interruption: run_all(experiment, arguments, interruption),
    )


def run_all(experiment: Experiment, arguments: Sequence[str], interruption: Interruption) -> None:
    """Every level and seed of a command line; the failure of one comes after all others."""
    configs = parse(experiment.domain, arguments)
    runtime.start(configs[0].cluster)
    versions = results.versions()  # of the code that runs, whatever is committed meanwhile
    console = Console(quiet=not processes.is_first(), markup=False)
    runs = [(config, seed) for config in configs for seed in config.seeds]
    rows, failure = [], None
    for config, seed in runs:
        try:
            rows.append(run_one(experiment, config, seed, versions, console, interruption))
            for again in searching(experiment, config, seed):
                rows.append(run_one(experiment, again, seed, versions, console, interruption))
        except program.FAILURES as error:
            if len(runs) > 1:  # the others can still be run
                console.print(f"{config.level}, seed {seed}, failed: {error}")
            failure = failure or error
    if rows:
        console.print(results.success_table(rows), results.time_table(rows))
    if failure is not None:
        raise failure


def searching(experiment: Experiment, config: AnyConfig, seed: int) -> list[AnyConfig]:
    """The other ways to plan with what a run has learned, if it has learned anything.

    Raises:
        UserError: the run is recorded, and one of them is not, but what was learned is not here.
    """
    if config.checkpoint is not None:
        return []
    folder = run_folder(experiment, config, seed)
    others = experiment.searches(config)
    found = [dataclasses.replace(o, checkpoint=folder, pictures=False) for o in others]

    def out_of_reach() -> int:
        if folder.is_dir():
            return 0
        known = {row["hash"] for row in results.read(rows_of(experiment, config))}
        return sum(configuration_hash(each, seed) not in known for each in found)

    count = processes.first_does(out_of_reach)
    if count:
        raise UserError(
            f"{config.level}, seed {seed}, is recorded, and {count} of {len(found)} ways to search "
            f"with it are not, but {folder} is not here: --force trains it again"
        )
    return found


def rows_of(experiment: Experiment, config: AnyConfig) -> Path:
    """The file that rows go to."""
    return results.folder(config.record, config.runs) / f"{experiment.name}.jsonl"


def run_folder(experiment: Experiment, config: AnyConfig, seed: int) -> Path:
    """Where a run leaves what it makes."""
    level = re.sub(r"[^\w.-]", "-", config.level)  # ids of environments may have a slash
    of = f"{level}-{config.method}-{config.preset}-seed{seed}"
    label = f"{experiment.name}-{of}-{configuration_hash(config, seed)}"
    return config.runs / ("evaluations" if config.checkpoint else "") / label


def make_run(
    experiment: Experiment,
    config: AnyConfig,
    seed: int,
    console: Console,
    interruption: Interruption,
) -> Run:
    """What every step of one level and one seed needs."""
    domain, folder = make_domain(config), run_folder(experiment, config, seed)
    return Run(config, domain, specify(config, seed, domain), folder, console, interruption)


def run_one(
    experiment: Experiment,
    config: AnyConfig,
    seed: int,
    versions: dict[str, str],
    console: Console,
    interruption: Interruption,
) -> results.Row:
    """One level and one seed, from demonstrations to a row."""
    name = configuration_hash(config, seed)
    # Read even where nothing is looked for: a damaged file is better found now than after the run.
    rows = rows_of(experiment, config)
    known = processes.first_does(lambda: results.find(rows, name))
    if config.record and not config.force and known is not None:
        console.print(f"{config.level}, seed {seed}: recorded already (--force runs it again)")
        return known
    played = episode_seeds(config)
    this = make_run(experiment, config, seed, console, interruption)
    folder = this.folder
    console.print(
        f"{config.level}, {config.method}, preset {config.preset}, seed {seed}: "
        f"{config.checkpoint or folder}",
    )  # fmt: skip
    # What can be refused is refused before the run has a folder.
    if config.episodes < jax.process_count():
        raise UserError(
            f"--episodes {config.episodes}: fewer than the {jax.process_count()} processes"
        )
    # Not after hours of work.
    for where in (rows.parent, config.runs):
        processes.first_does(functools.partial(files.check_writable, where))
    metrics: run.Metrics = []
    with contextlib.ExitStack() as stack:
        if processes.is_first():
            this = run.with_loggers(this, name, stack)
        if config.checkpoint is not None:
            if config.play in (None, config.level):  # another level's seeds are others
                seeds.check_disjoint(run.demonstrated(config.checkpoint), played)
            planner = run.reuse(this, config.checkpoint)
        else:
            planner, metrics = train(this, played, stack)
        planner = run.with_rules(planner, this)
        episodes = run.measure(planner, this, played)
        row = make_row(experiment, this, name, planner, episodes) | {"versions": versions}
        this.log(
            config.training.steps,
            {
                "evaluation/success": row["successes"] / row["episodes"],
                "evaluation/return": row["mean_return"],
                "evaluation/length": row["mean_length"],
            },
        )

        def write() -> None:
            results.write_csv(folder / "episodes.csv", episodes)
            results.record(rows, row, episodes)
            if config.pictures:
                run.draw(planner, this, played if experiment.iterations else None, metrics)
                if experiment.animate is not None:
                    experiment.animate(planner, this, played[:3], folder / "plan.gif")
                console.print(f"pictures: {folder}", highlight=False)

        processes.first_does(write)
    console.print(results.summarize(row))
    return row


def train(
    this: Run,
    played: range,
    stack: contextlib.ExitStack,
    watch: run.Watch | None = None,
    plays: bool = True,
) -> tuple[Pretrained, run.Metrics]:
    """What one run learns, from demonstrations on.

    Args:
        this: run to do.
        played: level seeds that it may not learn from.
        stack: keeps other processes out of its folder, until it is closed.
        watch: see `run.fit`.
        plays: see `run.compile_ahead`.
    """
    mesh = run.training_mesh(this.config)
    begun = functools.cache(lambda: run.compile_ahead(this, mesh, plays))
    if run.must_collect(this):
        if this.domain.with_statistics is None:  # a network that needs none of what is collected
            begun()  # programs compile meanwhile
        run.collect(this)
    data = run.load(this)
    this = run.measured(this, data)
    seeds.check_disjoint([d.seed for d in data], played)
    processes.first_does(lambda: stack.enter_context(files.only_process_in(this.folder)))
    return run.fit(this, data, mesh, lambda: begun()(), watch)


def describe_success(this: Run) -> dict[str, Any]:
    """What success means in a row, and how well the data do by it, where that is not plain."""
    config, criterion = this.config, this.domain.criterion
    if criterion is None:
        return {}
    same = config.play in (None, config.level)
    data = run.read_outcome(config.checkpoint or this.folder) if same else None
    return {
        "criterion": str(criterion),
        "criterion_given": criterion.given,
        "data_success": None if data is None else data[0],
        "data_return": None if data is None else data[1],
    }


def make_row(
    experiment: Experiment, this: Run, name: str, planner: Pretrained, episodes: Episodes
) -> results.Row:
    """The JSON row of a finished run."""
    config, lengths = this.config, episodes.lengths
    return {
        "experiment": experiment.name,
        "domain": config.domain,
        "level": config.level,
        "played": this.domain.level,
        "method": config.method,
        "preset": config.preset,
        "seed": this.seed,
        "demos": config.demos,
        "episodes": len(episodes.seeds),
        "first_episode_seed": int(episodes.seeds[0]),
        "validation": config.validation,
        "successes": int(episodes.successes.sum()),
        "mean_return": float(episodes.returns.mean()),
        "return_error": scores.standard_error(episodes.returns),
        "mean_length": float(lengths.mean()),
        "mean_success_length": float(lengths[episodes.successes].mean())
        if episodes.successes.any()
        else None,
        "horizon": config.planner.horizon,
        "iterations": config.planner.iterations,
        "executed": config.executed or config.planner.horizon,
        "train_steps": 0 if config.checkpoint else config.training.steps,
        **{f"{part}_seconds": round(value, 3) for part, value in this.seconds.items()},
        "plans": episodes.plans,
        "plans_per_second": episodes.plans / episodes.planning_seconds,
        "params": int(sum(x.size for x in jax.tree.leaves(planner.params))),
        "paper_success": this.domain.paper_success.get(this.config.method),
        **describe_success(this),
        "date": results.today(),
        "hash": name,
        "configuration": resolved(config, this.seed),
    }
