"""LEAP on BabyAI (paper, table 1): `python -m experiments.babyai --help`.

Collects demonstrations, trains, plans by Gibbs sampling on held-out levels, and reports
the success rate beside the paper's.
"""

import contextlib
import csv
import json
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from experiments import animation, plots, results, runtime
from experiments.config import Config, configuration_hash, parse, resolved
from experiments.interruption import Interrupted, Interruption, interruptible
from experiments.progress import Meter
from leapjax import files, pretrained, rollouts, sharding, training
from leapjax.agents import leap
from leapjax.checkpoints import Checkpoints, read_json
from leapjax.data import demonstrations, seeds, storage, windows
from leapjax.data.demonstrations import Demonstration
from leapjax.envs import levels, vocabulary
from leapjax.envs.adapter import BabyAIAdapter
from leapjax.envs.levels import Level
from leapjax.errors import UserError
from leapjax.planners import NotANumber, compile_planner
from leapjax.pretrained import Pretrained, Specification
from leapjax.rollouts import Episodes
from leapjax.types import TrainState

EXPERIMENT = "babyai"
RECORDED = Path("results") / f"{EXPERIMENT}.jsonl"
Metrics = list[dict[str, float]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    console = Console()
    try:
        configs = parse(arguments)
        runtime.start()
        with interruptible() as interruption:
            rows = [
                run(config, seed, console, interruption)
                for config in configs
                for seed in config.seeds
            ]
        console.print(results.success_table(rows), results.time_table(rows))
    except Interrupted as stopped:
        command = shlex.join(["python", "-m", "experiments.babyai", *arguments])
        print(f"stopped by {stopped}; continue with: {command}", file=sys.stderr)
        return stopped.exit_code
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except NotANumber as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except training.NonFiniteLoss as error:
        print(f"error: {error}; the last checkpoint is from before it", file=sys.stderr)
        return 1
    return 0


def run(config: Config, seed: int, console: Console, interruption: Interruption) -> results.Row:
    """One level and one seed, from demonstrations to a row."""
    name = configuration_hash(config, seed)
    known = results.find(RECORDED, name) if config.record and not config.force else None
    if known is not None:
        console.print(f"{config.level}, seed {seed}: recorded already (--force runs it again)")
        return known
    level = levels.find_level(config.level)
    first = seeds.validation_seeds if config.validation else seeds.test_seeds
    episode_seeds = first(config.test_seed, config.episodes)
    folder = config.runs / f"{EXPERIMENT}-{config.level}-{config.preset}-seed{seed}-{name}"
    console.print(f"[bold]{config.level}[/bold], preset {config.preset}, seed {seed}: {folder}")
    seconds: dict[str, float] = {"demos": 0, "compile": 0, "train": 0, "eval": 0}
    # What can be refused is refused before the run has a folder.
    trained = None if config.checkpoint is None else reuse(config, level)
    begun = time.perf_counter()
    data = gather(config, level, seed, console) if trained is None else []
    seeds.check_disjoint([d.seed for d in data], episode_seeds)
    seconds["demos"] = time.perf_counter() - begun
    with files.only_process_in(folder):
        if trained is None:
            planner, metrics, steps = fit(
                config, level, seed, data, folder, seconds, console, interruption
            )
        else:
            planner, metrics, steps = trained, [], 0
        episodes = measure(planner, config, level, seed, episode_seeds, seconds, console)
        row = make_row(config, level, seed, name, planner, episodes, seconds, steps)
        results.record(RECORDED if config.record else config.runs / RECORDED.name, row)
        if config.pictures:
            draw(planner, config, level, seed, episode_seeds, metrics, folder, console)
    console.print(
        f"success {results.percent(row)}, mean length {row['mean_length']:.1f}"
        + (f", paper {level.paper_success}%" if level.paper_success is not None else "")
    )
    return row


def fit(
    config: Config,
    level: Level,
    seed: int,
    data: Sequence[Demonstration],
    folder: Path,
    seconds: dict[str, float],
    console: Console,
    interruption: Interruption,
) -> tuple[Pretrained, Metrics, int]:
    """Trains, or continues, one run; what it learned and how it went."""
    specification = Specification(
        config.level, config.model,
        pretrained.sizes_for(level, config.context, config.planner.horizon),
        config.training, config.planner, level.words, vocabulary.WORDS,
    )  # fmt: skip
    examples = windows.concatenate(data)
    check_data(folder, windows.fingerprint(examples))
    mesh = sharding.data_mesh(config.training.batch)
    steps = sharding.replicate(examples, mesh)

    agent = pretrained.make_agent(specification, sharding.DATA)
    pretrained.save_specification(folder, specification)
    files.write_text(folder / "config.json", json.dumps(resolved(config, seed), indent=1))
    saved = Checkpoints(folder / pretrained.CHECKPOINTS)
    begun = time.perf_counter()
    key = sharding.replicate(jax.random.key(seed), mesh)
    state = sharding.replicate(jax.jit(agent.init)(jax.random.key(seed)), mesh)
    metrics = read_metrics(folder)
    restored = saved.restore(state, skipped=lambda line: print(line, file=sys.stderr))
    if restored is not None:
        state = restored
        metrics = [m for m in metrics if m["step"] <= int(state.step)]
        console.print(f"continuing at step {int(state.step)} of {config.training.steps}")
    else:
        metrics = []
    step = training.make_train_step(
        agent, lambda k, d: leap.make_batch(k, d, config.training, specification.sizes), mesh
    )
    compiled = step.lower(state, steps, key).compile()  # type: ignore[attr-defined]
    seconds["compile"] = time.perf_counter() - begun

    before = metrics[-1]["seconds"] if metrics else 0.0
    begun = last_saved = time.perf_counter()
    total = config.training.steps
    with (
        interruption.deferred(),
        contextlib.closing(saved),
        Meter(console, "training", total, int(state.step)) as meter,
    ):

        def report(done: int, now: TrainState, means: dict[str, float]) -> None:
            nonlocal last_saved
            elapsed = before + time.perf_counter() - begun
            metrics.append({"step": done, "seconds": elapsed, **means})
            meter.update(done, f"loss {means['loss']:.3f} accuracy {means['accuracy']:.1%}")
            due = time.perf_counter() - last_saved > config.checkpoint_seconds
            if done == total or interruption.requested or due:
                write_metrics(folder, metrics)
                saved.save(now)
                last_saved = time.perf_counter()

        state = training.train(
            compiled, state, steps, key, total, report, stop=lambda: interruption.requested
        )
    seconds["train"] = metrics[-1]["seconds"] if metrics else 0.0
    assert agent.energy is not None
    plan = compile_planner(agent.energy, config.planner)
    return Pretrained(specification, agent.energy, state.params, plan), metrics, total


def check_data(folder: Path, fingerprint: str) -> None:
    """Refuses to continue a run that was begun on other demonstrations."""
    path = folder / "data.json"
    if path.exists():
        values = read_json(path)
        before = values.get("fingerprint") if isinstance(values, dict) else None
        if before != fingerprint:
            raise UserError(
                f"{folder} was begun on other demonstrations ({before}, now {fingerprint}): "
                "remove it to begin again, or give this run another --runs folder"
            )
    files.write_text(path, json.dumps({"fingerprint": fingerprint}))


def gather(config: Config, level: Level, seed: int, console: Console) -> list[Demonstration]:
    """The demonstrations to train on: the user's, the cached ones, or new ones."""
    side = pretrained.sizes_for(level, config.context, config.planner.horizon).side
    if config.demonstrations is not None:
        data = storage.load(config.demonstrations, level, side)
        if len(data) < config.demos:
            raise UserError(
                f"{config.demonstrations} has {len(data)} episodes, fewer than --demos "
                f"{config.demos}"
            )
        return data[: config.demos]
    name = storage.dataset_id(level, config.demos, seed)
    if not storage.exists(name):
        with Meter(console, "demonstrations", config.demos) as meter:
            collection = demonstrations.collect(level, config.demos, seed, meter.update)
        dropped = (
            f"dropped: {collection.failed} failed, "
            f"{collection.other_goal} ended at another match than the nearest"
        )
        console.print(f"{config.demos} demonstrations, {dropped}")
        storage.save(name, collection, f"{config.demos} demonstrations of {level.name}; {dropped}")
    return storage.load(name, level, side)


def reuse(config: Config, level: Level) -> Pretrained:
    """The planner of `--checkpoint`, refused where it belongs to something else."""
    assert config.checkpoint is not None
    specification = pretrained.read_specification(config.checkpoint)
    sizes = pretrained.sizes_for(level, config.context, config.planner.horizon)
    wanted = {
        "level": config.level,
        "side": sizes.side,
        "context": config.context,
        "horizon": config.planner.horizon,
        "words": level.words,
        "model": config.model,
    }
    found = {
        "level": specification.level,
        "side": specification.sizes.side,
        "context": specification.sizes.context,
        "horizon": specification.sizes.horizon,
        "words": specification.words,
        "model": specification.model,
    }
    differing = [f"{k} is {found[k]}, not {wanted[k]}" for k in wanted if found[k] != wanted[k]]
    if differing:
        raise UserError(f"{config.checkpoint} does not fit: {'; '.join(differing)}")
    return pretrained.load(config.checkpoint, config.planner)


def measure(
    planner: Pretrained,
    config: Config,
    level: Level,
    seed: int,
    episode_seeds: range,
    seconds: dict[str, float],
    console: Console,
) -> Episodes:
    """Plays the held-out episodes; compilation is counted apart."""
    play = player(planner, config, level, seed)
    begun = time.perf_counter()
    warm_up(planner, level, len(episode_seeds))
    seconds["compile"] += time.perf_counter() - begun
    with Meter(console, "evaluation", len(episode_seeds)) as meter:
        episodes = play(
            episode_seeds,
            progress=lambda over, good: meter.update(over, f"success {good}/{over}"),
        )
    seconds["eval"] = episodes.seconds
    return episodes


def player(planner: Pretrained, config: Config, level: Level, seed: int) -> Callable[..., Episodes]:
    """`rollouts.evaluate` with all that a run fixes."""

    def play(episode_seeds: Sequence[int], **options: Any) -> Episodes:
        return rollouts.evaluate(
            lambda: BabyAIAdapter(level), episode_seeds, planner.plan, planner.params,
            context=config.context, seed=seed, executed=config.executed, **options,
        )  # fmt: skip

    return play


def warm_up(planner: Pretrained, level: Level, batch: int) -> None:
    """Compiles every chunk size that a batch of that many and fewer plans can need."""
    adapter = BabyAIAdapter(level)
    history = rollouts.History(
        adapter.reset(0), planner.specification.sizes.context, adapter.num_actions
    )
    for size in planner.plan.sizes_up_to(batch):
        contexts = rollouts.stack_contexts([history] * size)
        jax.block_until_ready(planner(jax.random.split(jax.random.key(0), size), contexts))


def make_row(
    config: Config,
    level: Level,
    seed: int,
    name: str,
    planner: Pretrained,
    episodes: Episodes,
    seconds: dict[str, float],
    steps: int,
) -> results.Row:
    """The JSON row of a finished run."""
    lengths = episodes.lengths
    return {
        "experiment": EXPERIMENT,
        "level": config.level,
        "method": "leap",
        "preset": config.preset,
        "seed": seed,
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
        "train_steps": steps,
        **{f"{part}_seconds": round(value, 3) for part, value in seconds.items()},
        "plans": episodes.plans,
        "plans_per_second": episodes.plans / episodes.planning_seconds,
        "params": int(sum(x.size for x in jax.tree.leaves(planner.params))),
        "paper_success": level.paper_success,
        "versions": results.versions(),
        "date": results.today(),
        "hash": name,
        "configuration": resolved(config, seed),
    }


def draw(
    planner: Pretrained,
    config: Config,
    level: Level,
    seed: int,
    episode_seeds: range,
    metrics: Metrics,
    folder: Path,
    console: Console,
) -> None:
    """Loss, success against iterations, and a plan refined and executed."""
    folder.mkdir(parents=True, exist_ok=True)
    if metrics:
        plots.loss(metrics, folder / "loss.png")
    play = player(planner, config, level, seed)
    some = episode_seeds[:100]
    iterations = sorted({1, 2, 3, 5, *np.linspace(1, config.planner.iterations, 5).astype(int)})
    iterations = [int(n) for n in iterations if n <= config.planner.iterations]
    outcomes = [play(some, iteration=n) for n in iterations]
    plots.success_by_iteration(
        iterations, [(int(o.successes.sum()), len(some)) for o in outcomes],
        f"{config.level}, preset {config.preset}", folder / "iterations.png",
    )  # fmt: skip
    animation.animate(planner, level, episode_seeds[:3], seed, folder / "plan.gif")
    console.print(f"pictures: {folder}/*.png, {folder}/plan.gif", highlight=False)


def write_metrics(folder: Path, metrics: Metrics) -> None:
    """The training curve as CSV."""
    lines = [",".join(metrics[0])]
    lines += [",".join(repr(value) for value in entry.values()) for entry in metrics]
    files.write_text(folder / "metrics.csv", "\n".join(lines) + "\n")


def read_metrics(folder: Path) -> Metrics:
    """The training curve so far."""
    path = folder / "metrics.csv"
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [{k: float(v) for k, v in entry.items()} for entry in csv.DictReader(file)]


if __name__ == "__main__":
    sys.exit(main())
