"""LEAP on BabyAI (paper, table 1): `python -m experiments.babyai --help`.

Collects demonstrations, trains, plans by Gibbs sampling on held-out levels, and reports
the success rate beside the paper's.
"""

import contextlib
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
from rich.console import Console

from experiments import pipeline, results, runtime
from experiments.config import Config, configuration_hash, episode_seeds, parse, resolved
from experiments.interruption import Interrupted, Interruption, interruptible
from experiments.pipeline import Run
from leapjax import files, pretrained, processes, training
from leapjax.batching import NotANumber
from leapjax.data import seeds
from leapjax.envs import levels
from leapjax.errors import UserError, first_line
from leapjax.pretrained import Pretrained
from leapjax.rollouts import Episodes

EXPERIMENT = "babyai"
RECORDED = Path("results") / f"{EXPERIMENT}.jsonl"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        configs = parse(arguments)
        runtime.start(configs[0].cluster)
        console = Console(quiet=not processes.is_first())
        with interruptible() as interruption:
            rows = [
                run_one(config, seed, console, interruption)
                for config in configs
                for seed in config.seeds
            ]
        console.print(results.success_table(rows), results.time_table(rows))
    except Interrupted as stopped:
        command = shlex.join(["python", "-m", "experiments.babyai", *arguments])
        print(f"stopped by {stopped}; continue with: {command}", file=sys.stderr)
        return runtime.leave(stopped.exit_code)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return runtime.leave(2)
    except NotANumber as error:
        print(f"error: {error}", file=sys.stderr)
        return runtime.leave(1)
    except training.NonFiniteLoss as error:
        print(f"error: {error}; the last checkpoint is from before it", file=sys.stderr)
        return runtime.leave(1)
    except jax.errors.JaxRuntimeError as error:
        if not jax.distributed.is_initialized():
            raise
        reason = first_line(error)
        print(
            f"error: the processes of this run have lost each other ({reason}): start all of them "
            "again, and they continue from the last checkpoint", file=sys.stderr,
        )  # fmt: skip
        return runtime.leave(1)
    return 0


def run_one(config: Config, seed: int, console: Console, interruption: Interruption) -> results.Row:
    """One level and one seed, from demonstrations to a row."""
    name = configuration_hash(config, seed)
    if config.record and not config.force:
        known = processes.first_does(lambda: results.find(RECORDED, name))
        if known is not None:
            console.print(f"{config.level}, seed {seed}: recorded already (--force runs it again)")
            return known
    level = levels.find_level(config.level)
    played = episode_seeds(config)
    folder = config.runs / f"{EXPERIMENT}-{config.level}-{config.preset}-seed{seed}-{name}"
    console.print(f"[bold]{config.level}[/bold], preset {config.preset}, seed {seed}: {folder}")
    sizes = pretrained.sizes_for(level, config.context, config.planner.horizon)
    run = Run(config, level, seed, sizes, folder, console, interruption)
    # What can be refused is refused before the run has a folder.
    if config.episodes < jax.process_count():
        raise UserError(
            f"--episodes {config.episodes}: fewer than the {jax.process_count()} processes"
        )
    trained, data = None, []
    if config.checkpoint is not None:
        trained = pipeline.reuse(run)
    else:
        mesh = pipeline.training_mesh(config)
        data = pipeline.gather(run)
    seeds.check_disjoint([d.seed for d in data], played)
    with contextlib.ExitStack() as stack:
        processes.first_does(lambda: stack.enter_context(files.only_process_in(folder)))
        planner, metrics = (trained, []) if trained else pipeline.fit(run, data, mesh)
        episodes = pipeline.measure(planner, run, played)
        row = make_row(run, name, planner, episodes)

        def write() -> None:
            results.record(RECORDED if config.record else config.runs / RECORDED.name, row)
            if config.pictures:
                pipeline.draw(planner, run, played, metrics)

        processes.first_does(write)
    console.print(
        f"success {results.percent(row)}, mean length {row['mean_length']:.1f}"
        + (f", paper {level.paper_success}%" if level.paper_success is not None else "")
    )
    return row


def make_row(run: Run, name: str, planner: Pretrained, episodes: Episodes) -> results.Row:
    """The JSON row of a finished run."""
    config, lengths = run.config, episodes.lengths
    return {
        "experiment": EXPERIMENT,
        "level": config.level,
        "method": "leap",
        "preset": config.preset,
        "seed": run.seed,
        "demos": config.demos,
        "episodes": len(episodes.seeds),
        "first_episode_seed": int(episodes.seeds[0]),
        "validation": config.validation,
        "successes": int(episodes.successes.sum()),
        "mean_length": float(lengths.mean()),
        "mean_success_length": float(lengths[episodes.successes].mean())
        if episodes.successes.any()
        else None,
        "horizon": config.planner.horizon,
        "iterations": config.planner.iterations,
        "executed": config.executed or config.planner.horizon,
        "train_steps": 0 if config.checkpoint else config.training.steps,
        **{f"{part}_seconds": round(value, 3) for part, value in run.seconds.items()},
        "plans": episodes.plans,
        "plans_per_second": episodes.plans / episodes.planning_seconds,
        "params": int(sum(x.size for x in jax.tree.leaves(planner.params))),
        "paper_success": run.level.paper_success,
        "versions": results.versions(),
        "date": results.today(),
        "hash": name,
        "configuration": resolved(config, run.seed),
    }


if __name__ == "__main__":
    sys.exit(main())
