"""Runs every level, method and seed of a command line; each makes a row."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import jax
from rich.console import Console

from leapjax import files, processes
from leapjax.configuration import AnyConfig, choose_episode_seeds, hash_config
from leapjax.errors import UserError
from leapjax.running import jax_setup, results, shell
from leapjax.running.command_line import parse
from leapjax.running.data import load_demonstrations
from leapjax.running.evaluate import evaluate
from leapjax.running.interruption import Interruption
from leapjax.running.record import record
from leapjax.running.run import Experiment, Run, find_folder, locate_rows, open_run
from leapjax.running.train import train
from leapjax.running.trained import add_rules, load_trained


def main(experiment: Experiment, arguments: Sequence[str] | None = None) -> int:
    """Runs every level, method and seed of a command line; returns the exit code."""
    given = shell.read_arguments(arguments)
    return shell.run_interruptible_program(
        experiment.module, given, lambda interruption: run_all(experiment, given, interruption)
    )


def run_all(experiment: Experiment, arguments: Sequence[str], interruption: Interruption) -> None:
    """Runs every level, method and seed; raises the first failure after all others have run."""
    configs = parse(experiment.domain, arguments, experiment.config, experiment.module)
    jax_setup.start(configs[0].cluster)
    versions = results.find_versions()  # read now: later commits do not change this program
    console = Console(quiet=not processes.is_first(), markup=False)
    runs = [(config, seed) for config in configs for seed in config.seeds]
    rows, failure = [], None
    for config, seed in runs:
        try:
            rows.append(finish(experiment, config, seed, versions, console, interruption))
            for again in find_variants(experiment, config, seed):
                rows.append(finish(experiment, again, seed, versions, console, interruption))
        except shell.FAILURES as error:
            if len(runs) > 1:  # the other runs go on
                console.print(f"{config.level}, seed {seed}, failed: {shell.describe(error)}")
            failure = failure or error
    if rows:
        console.print(results.make_success_table(rows), results.make_time_table(rows))
    if failure is not None:
        raise failure
    compare(experiment, configs, console)


def finish(
    experiment: Experiment,
    config: AnyConfig,
    seed: int,
    versions: Mapping[str, str],
    console: Console,
    interruption: Interruption,
) -> results.Row:
    """Returns the row of a configuration and a seed; runs it unless the row is recorded."""
    rows, name = locate_rows(experiment, config), hash_config(config, seed)
    # Always read: a damaged file raises here, before hours of work.
    known = processes.run_on_first(lambda: results.find(rows, name))
    if config.record and not config.force and known is not None:
        checkpoint = config.checkpoint and config.checkpoint.name
        if known.get("checkpoint", checkpoint) != checkpoint:
            raise UserError(
                f"the recorded row is of the checkpoint {known['checkpoint']}, not of "
                f"{checkpoint}: --force replaces it"
            )
        console.print(f"{config.level}, seed {seed}: recorded already (--force runs it again)")
        return known
    with open_run(experiment, config, seed, console, interruption) as run:
        console.print(
            f"{config.level}, {config.method}, preset {config.preset}, seed {seed}: "
            f"{config.checkpoint or run.folder}"
        )
        check_start(run)
        return complete(run, versions)


def check_start(run: Run) -> None:
    """Checks conditions that would otherwise fail after hours of work.

    Raises:
        UserError: there are fewer episodes than processes, or a folder cannot be written to.
    """
    if run.config.episodes < jax.process_count():
        raise UserError(
            f"--episodes {run.config.episodes}: fewer than the {jax.process_count()} processes"
        )
    for where in (run.rows.parent, run.config.runs):
        processes.run_on_first(functools.partial(files.check_writable, where))


def complete(run: Run, versions: Mapping[str, str]) -> results.Row:
    """Runs every step from the demonstrations to the row; returns the row."""
    if run.config.checkpoint is None:
        data = load_demonstrations(run)
        planner = train(run, data)
    else:
        planner = load_trained(run)
    planner = add_rules(run, planner)
    episodes = evaluate(run, planner)
    return record(run, planner, episodes, versions)


def compare(experiment: Experiment, configs: Sequence[AnyConfig], console: Console) -> None:
    """Prints the results of solvers without learning on each played level."""
    if experiment.compare is None:
        return
    played = {config.play or config.level: choose_episode_seeds(config) for config in configs}
    for level, seeds in played.items():
        console.print(f"{level}, solvers without learning:")
        console.print(experiment.compare(level, seeds))


def find_variants(experiment: Experiment, config: AnyConfig, seed: int) -> list[AnyConfig]:
    """Returns configurations of other searches or levels for the parameters of a run.

    Raises:
        UserError: the folder of the run is missing, and some of these configurations have no row.
    """
    if config.checkpoint is not None or experiment.variants is None:
        return []
    folder = find_folder(experiment, config, seed)
    others = experiment.variants(config)
    found = [dataclasses.replace(o, checkpoint=folder, pictures=False) for o in others]

    def count_unreachable() -> int:
        if folder.is_dir():
            return 0
        known = {row["hash"] for row in results.read(locate_rows(experiment, config))}
        return sum(hash_config(each, seed) not in known for each in found)

    count = processes.run_on_first(count_unreachable)
    if count:
        raise UserError(
            f"{config.level}, seed {seed}, is recorded, and {count} of {len(found)} ways to search "
            f"with it are not, but {folder} is not here: --force trains it again"
        )
    return found
