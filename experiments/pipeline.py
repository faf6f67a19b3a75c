"""One run: a level and a training seed, from demonstrations to measured episodes.

The steps that experiments on grid worlds share. With several processes all of them go
through all steps; the first one writes.
"""

import contextlib
import csv
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console

from experiments import animation, plots
from experiments.config import CONFIGURATION, Config, read_origin, resolved
from experiments.interruption import Interruption
from experiments.progress import Meter
from leapjax import files, pretrained, processes, rollouts, sharding, training
from leapjax.agents import leap
from leapjax.batching import compile_planner
from leapjax.checkpoints import Checkpoints, read_json
from leapjax.data import demonstrations, storage, windows
from leapjax.data.demonstrations import Demonstration
from leapjax.envs import vocabulary
from leapjax.envs.adapter import BabyAIAdapter
from leapjax.envs.levels import Level
from leapjax.errors import UserError, first_line
from leapjax.models.trajectory import Sizes
from leapjax.pretrained import Pretrained, Specification
from leapjax.rollouts import Episodes
from leapjax.types import TrainState

Metrics = list[dict[str, float]]


@dataclasses.dataclass(frozen=True)
class Run:
    """What every step of a run needs."""

    config: Config
    level: Level
    seed: int
    sizes: Sizes
    folder: Path
    console: Console
    interruption: Interruption
    # Where the time went, filled in by each step.
    seconds: dict[str, float] = dataclasses.field(
        default_factory=lambda: {"demos": 0.0, "compile": 0.0, "train": 0.0, "eval": 0.0}
    )


def gather(run: Run) -> list[Demonstration]:
    """The demonstrations to train on: the user's, the cached ones, or new ones."""
    config, level, side = run.config, run.level, run.sizes.side
    begun = time.perf_counter()
    name = config.demonstrations or storage.dataset_id(level, config.demos, run.seed)
    if config.demonstrations is None:
        processes.first_does(lambda: None if storage.exists(name) else _collect(run, name))
    # Each process reads for itself: the data need not be on one shared disk.
    data = processes.together(lambda: storage.load(name, level, side))
    if len(data) < config.demos:
        raise UserError(f"{name} has {len(data)} episodes, fewer than --demos {config.demos}")
    run.seconds["demos"] = time.perf_counter() - begun
    return data[: config.demos]


def _collect(run: Run, name: str) -> None:
    count = run.config.demos
    with Meter(run.console, "demonstrations", count) as meter:
        collection = demonstrations.collect(run.level, count, run.seed, meter.update)
    dropped = (
        f"dropped: {collection.failed} failed, "
        f"{collection.other_goal} ended at another match than the nearest"
    )
    run.console.print(f"{count} demonstrations, {dropped}")
    storage.save(name, collection, f"{count} demonstrations of {run.level.name}; {dropped}")


def fit(run: Run, data: Sequence[Demonstration], mesh: Mesh) -> tuple[Pretrained, Metrics]:
    """Trains, or continues; what was learned and how it went."""
    config, folder, console, total = run.config, run.folder, run.console, run.config.training.steps
    specification = Specification(
        config.level, config.model, run.sizes, config.training, config.planner, run.level.words,
        vocabulary.WORDS,
    )  # fmt: skip
    examples = windows.concatenate(data)
    check_data(folder, windows.fingerprint(examples))

    def describe() -> None:
        pretrained.save_specification(folder, specification)
        files.write_text(folder / CONFIGURATION, json.dumps(resolved(config, run.seed), indent=1))

    processes.first_does(describe)
    begun = time.perf_counter()
    agent = pretrained.make_agent(specification, mesh)
    state, key = training.make_begin(agent, mesh)(run.seed)
    steps = sharding.replicate(examples, mesh)
    saved = Checkpoints(folder / pretrained.CHECKPOINTS)
    restored = saved.restore(state, skipped=lambda line: print(line, file=sys.stderr))
    metrics: Metrics = []
    if restored is not None:
        state = restored
        metrics = [m for m in read_metrics(folder) if m["step"] <= int(state.step)]
        console.print(f"continuing at step {int(state.step)} of {total}")
    step = training.make_train_step(
        agent, lambda k, d: leap.make_batch(k, d, config.training, run.sizes)
    )
    compiled = step.lower(state, steps, key).compile()  # type: ignore[attr-defined]
    run.seconds["compile"] = time.perf_counter() - begun

    before = metrics[-1]["seconds"] if metrics else 0.0
    begun = last_saved = time.perf_counter()
    with (
        run.interruption.deferred(),
        contextlib.closing(saved),
        Meter(console, "training", total, int(state.step)) as meter,
    ):

        def report(done: int, now: TrainState, means: dict[str, float]) -> bool:
            nonlocal last_saved
            elapsed = time.perf_counter() - begun
            metrics.append({"step": done, "seconds": before + elapsed, **means})
            meter.update(done, f"loss {means['loss']:.3f} accuracy {means['accuracy']:.1%}")
            due = time.perf_counter() - last_saved > config.checkpoint_seconds
            # Processes have their own clocks and signals, and must agree on what to do.
            signals, dues = zip(*processes.gather([run.interruption.requested, due]), strict=True)
            for number in filter(None, signals):
                run.interruption.adopt(number)
            if done == total or any(signals) or any(dues):
                processes.first_does(lambda: write_metrics(folder, metrics))
                saved.save(now)
                last_saved = time.perf_counter()
            return any(signals)

        state = training.train(compiled, state, steps, key, total, report)
    run.seconds["train"] = metrics[-1]["seconds"] if metrics else 0.0
    assert agent.energy is not None
    plan = compile_planner(agent.energy, config.planner)
    # Planning is each process's own business, on its own devices.
    params = jax.tree.map(jax.numpy.asarray, sharding.to_host(state.params))
    return Pretrained(specification, agent.energy, params, plan), metrics


def training_mesh(config: Config) -> Mesh:
    """The devices that a run trains on, those of all processes included.

    Raises:
        UserError: they cannot share the batch.
    """
    try:
        return sharding.make_mesh(config.training.batch, jax.devices(), config.cluster.fsdp)
    except ValueError as error:
        raise UserError(f"--batch, --fsdp: {error}") from None


def check_data(folder: Path, fingerprint: str) -> None:
    """Refuses to train, or to continue a run, on demonstrations that are not the same ones.

    Raises:
        UserError: the run was begun on others, or processes have read different ones.
    """
    if len(set(processes.gather(fingerprint))) > 1:
        raise UserError(
            "the processes have different demonstrations: copy one data set to all machines, or "
            "put MINARI_DATASETS_PATH on a shared disk"
        )

    def check() -> None:
        path = folder / "data.json"
        if not path.exists():
            return files.write_text(path, json.dumps({"fingerprint": fingerprint}))
        values = read_json(path)
        before = values.get("fingerprint") if isinstance(values, dict) else None
        if before != fingerprint:
            raise UserError(
                f"{folder} was begun on other demonstrations ({before}, now {fingerprint}): "
                "remove it to begin again, or give this run another --runs folder"
            )
        return None

    processes.first_does(check)


def reuse(run: Run) -> Pretrained:
    """The planner of `--checkpoint`, refused where it belongs to something else."""
    config, level, sizes = run.config, run.level, run.sizes
    assert config.checkpoint is not None
    specification = pretrained.read_specification(config.checkpoint)
    origin = read_origin(config.checkpoint)
    wanted = {
        "seed": run.seed,
        "demos": config.demos,
        "demonstrations": config.demonstrations,
        "level": config.level,
        "side": sizes.side,
        "context": config.context,
        "horizon": config.planner.horizon,
        "words": level.words,
        "model": config.model,
    }
    found = {
        "seed": origin.seed,
        "demos": origin.demos,
        "demonstrations": origin.demonstrations,
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


def measure(planner: Pretrained, run: Run, episode_seeds: range) -> Episodes:
    """Plays the held-out episodes, each process its share; compilation is counted apart."""
    play = player(planner, run)
    index, count = jax.process_index(), jax.process_count()
    # Contiguous shares, so that the parts make the whole again, in order.
    bounds = [len(episode_seeds) * n // count for n in range(count + 1)]
    mine = episode_seeds[bounds[index] : bounds[index + 1]]
    begun = time.perf_counter()
    warm_up(planner, run.level, len(mine))
    run.seconds["compile"] += time.perf_counter() - begun
    with Meter(run.console, "evaluation", len(mine)) as meter:

        def progress(over: int, good: int) -> None:
            run.interruption.check()
            meter.update(over, f"success {good}/{over}")

        part = play(mine, progress=progress)
    parts = processes.gather([*(array.tolist() for array in part[:3]), *part[3:]])
    episodes = rollouts.join(
        [Episodes(np.array(a), np.array(b), np.array(c), *counts) for a, b, c, *counts in parts]
    )
    run.seconds["eval"] = episodes.seconds
    return episodes


def player(planner: Pretrained, run: Run) -> Callable[..., Episodes]:
    """`rollouts.evaluate` with all that a run fixes."""

    def play(episode_seeds: Sequence[int], **options: Any) -> Episodes:
        return rollouts.evaluate(
            lambda: BabyAIAdapter(run.level), episode_seeds, planner.plan, planner.params,
            context=run.config.context, seed=run.seed, executed=run.config.executed, **options,
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


def draw(planner: Pretrained, run: Run, episode_seeds: range, metrics: Metrics) -> None:
    """Loss, success against iterations, and a plan refined and executed."""
    config, folder = run.config, run.folder
    folder.mkdir(parents=True, exist_ok=True)
    if metrics:
        plots.loss(metrics, folder / "loss.png")
    play = player(planner, run)
    some = episode_seeds[:100]
    iterations = sorted({1, 2, 3, 5, *np.linspace(1, config.planner.iterations, 5).astype(int)})
    iterations = [int(n) for n in iterations if n <= config.planner.iterations]
    outcomes = [play(some, iteration=n) for n in iterations]
    plots.success_by_iteration(
        iterations, [(int(o.successes.sum()), len(some)) for o in outcomes],
        f"{config.level}, preset {config.preset}", folder / "iterations.png",
    )  # fmt: skip
    animation.animate(planner, run.level, episode_seeds[:3], run.seed, folder / "plan.gif")
    run.console.print(f"pictures: {folder}/*.png, {folder}/plan.gif", highlight=False)


def write_metrics(folder: Path, metrics: Metrics) -> None:
    """The training curve as CSV."""
    lines = [",".join(metrics[0])]
    lines += [",".join(repr(value) for value in entry.values()) for entry in metrics]
    files.write_text(folder / "metrics.csv", "\n".join(lines) + "\n")


def read_metrics(folder: Path) -> Metrics:
    """The training curve so far.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / "metrics.csv"
    if not path.exists():
        return []
    lines = files.read_text(path).splitlines()
    try:
        metrics = [{k: float(v) for k, v in entry.items()} for entry in csv.DictReader(lines)]
        if any(not entry.keys() >= {"step", "seconds", "loss"} for entry in metrics):
            raise ValueError("a column is missing")
    except (TypeError, ValueError, csv.Error) as error:
        raise UserError(
            f"{path} is damaged ({first_line(error)}): remove it, and the run goes on with a "
            "training curve that begins here"
        ) from None
    return metrics
