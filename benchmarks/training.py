"""Training steps per second against this machine's limit: `python -m benchmarks.training`.

The steps are those of the main job: a batch is drawn and augmented, the gradient taken, the
parameters updated. What is in the grids does not change the speed, so they are random.
Compilation is timed apart. FLOPs are XLA's count for one step, set against the
matrix-multiply peak measured in the same run.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.planning import random_contexts
from benchmarks.timing import fastest, matmul_peak
from experiments import runtime
from experiments.config import PRESETS, Config, preset
from leapjax import files, pretrained, sharding, training
from leapjax.agents import leap
from leapjax.data.windows import Steps
from leapjax.envs import levels
from leapjax.errors import UserError
from leapjax.models.trajectory import Sizes
from leapjax.types import Params, PyTree

LEVELS = ("GoToLocalS7N5", "GoToObjMazeS4", "GoToObjMazeS7")
EPISODES, LENGTH = 100, 20  # of the made-up demonstrations
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure training."""

    levels: tuple[str, ...] = LEVELS
    """Whose settings to measure: horizon, context, grid."""
    presets: tuple[str, ...] = PRESETS
    """Which presets."""
    json: Path | None = None
    """Write the rows here."""
    seconds: float = 3.0
    """Time to spend on each measurement, at least."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes what was asked for."""
    options = tyro.cli(Options, args=None if arguments is None else list(arguments))
    runtime.use_every_core()  # and no compilation cache: compile times are real
    try:
        configs = [
            preset(levels.find_level(level), name)
            for level in options.levels
            for name in options.presets
        ]
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = [measure(config, options.seconds) for config in configs]
    Console().print(table(rows))
    if options.json:
        files.write_text(options.json, json.dumps(rows, indent=1) + "\n")
    return 0


def measure(config: Config, seconds: float) -> Row:
    """One preset on one level."""
    level = levels.find_level(config.level)
    sizes = pretrained.sizes_for(level, config.context, config.planner.horizon)
    batch = config.training.batch
    mesh = sharding.make_mesh(batch)
    agent = leap.make_agent(config.model, config.training, config.planner, sizes, level.words, mesh)
    state, key = training.make_begin(agent, mesh)(0)
    data = sharding.replicate(random_steps(sizes, level.words), mesh)

    def make_batch(key: jax.Array, data: PyTree) -> PyTree:
        return leap.make_batch(key, data, config.training, sizes)

    step = training.make_train_step(agent, make_batch)
    lowered = step.lower(state, data, key)  # type: ignore[attr-defined]
    compiled = lowered.compile()

    def advance() -> jax.Array:
        nonlocal state
        state, metrics = compiled(state, data, key)
        return metrics["loss"]

    def seconds_per_step() -> float:
        return fastest(lambda: [advance() for _ in range(5)], seconds) / 5

    taken = seconds_per_step()
    encoder = encoder_seconds(config, sizes, state.params, batch, seconds)
    single = leap.make_agent(config.model, config.training, config.planner, sizes, level.words)
    alone = training.make_train_step(single, make_batch)
    flops = alone.lower(state, data, key).cost_analysis()["flops"]  # type: ignore[attr-defined]
    tokens = batch * config.planner.horizon
    peak = matmul_peak(tokens, config.model.width, seconds)
    return {
        "level": config.level,
        "preset": config.preset,
        "horizon": config.planner.horizon,
        "side": sizes.side,
        "context": config.context,
        "batch": batch,
        "devices": mesh.size,
        "steps_per_second": 1 / taken,
        "encoder_share": encoder / taken,
        "flops_per_step": flops,
        "gflops": flops / taken / 1e9,
        "peak_gflops": peak,
        "fraction_of_peak": flops / taken / 1e9 / peak,
        "steps": config.training.steps,
        "training_seconds": config.training.steps * taken,
    }


def encoder_seconds(
    config: Config, sizes: Sizes, params: Params, batch: int, seconds: float
) -> float:
    """Seconds for the encoder of a batch and its gradient, on as many devices."""
    energy = leap.make_energy(config.model, sizes)
    mesh = sharding.make_mesh(batch)

    def gradient(_: None, params: Params, contexts: PyTree) -> PyTree:
        def total(params: Params) -> jax.Array:
            memory = jax.vmap(energy.encode, in_axes=(None, 0))(params, contexts)
            return jax.tree.reduce(jnp.add, jax.tree.map(jnp.sum, memory))

        # One row per device, so that the result is split as the batch is.
        return jax.tree.map(lambda leaf: leaf[None], jax.grad(total)(params))

    run = partial(sharding.split_batches(gradient, mesh), None)
    contexts = jax.tree.map(np.asarray, random_contexts(sizes, batch))
    jax.block_until_ready(run(params, contexts))
    return fastest(partial(run, params, contexts), seconds)


def random_steps(sizes: Sizes, words: int) -> Steps:
    """Demonstrations of the right shapes, of nothing in particular."""
    count = EPISODES * LENGTH
    contexts = random_contexts(dataclasses.replace(sizes, context=0), count, words)
    step = np.tile(np.arange(LENGTH, dtype=np.int32), EPISODES)
    return Steps(
        jax.tree.map(np.asarray, contexts.observation),
        np.random.default_rng(0).integers(0, 3, count).astype(np.int32),
        step,
        LENGTH - step,
        np.arange(EPISODES, dtype=np.int32) * LENGTH,
        np.full(EPISODES, LENGTH, np.int32),
        np.zeros((count, sizes.side, sizes.side), bool),
    )


def table(rows: Sequence[Row]) -> Table:
    """The rows for a terminal."""
    result = Table(
        "level", "preset", "steps/s", "ms/step", "encoder", "GFLOP/s", "peak", "fraction", "run"
    )
    for row in rows:
        result.add_row(
            row["level"],
            row["preset"],
            f"{row['steps_per_second']:.1f}",
            f"{1e3 / row['steps_per_second']:.1f}",
            f"{row['encoder_share']:.0%}",
            f"{row['gflops']:.0f}",
            f"{row['peak_gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
            f"{row['training_seconds']:.0f} s",
        )
    return result


if __name__ == "__main__":
    sys.exit(main())
