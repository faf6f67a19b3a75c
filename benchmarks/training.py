"""Training steps per second against this machine's limit: `python -m benchmarks.training`.

The steps are those of the main job: a batch is drawn and augmented, the gradient taken, the
parameters updated. What is in the grids does not change the speed, so they are random.
Compilation is timed apart. FLOPs are XLA's count for one step, set against the
matrix-multiply peak measured in the same run.
"""

import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.sharding import Mesh
from rich.console import Console
from rich.table import Table

from benchmarks.planning import random_contexts
from benchmarks.timing import Row, fastest, matmul_peak, write_rows
from experiments import runtime
from experiments.config import PRESETS, Config, preset
from leapjax import pretrained, sharding, training
from leapjax.agents import leap
from leapjax.data.windows import Steps
from leapjax.envs import levels
from leapjax.errors import UserError
from leapjax.models.trajectory import Sizes
from leapjax.types import Agent, Params, PyTree

LEVELS = ("GoToLocalS7N5", "GoToObjMazeS4", "GoToObjMazeS7")
EPISODES, LENGTH = 100, 20  # of the made-up demonstrations


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
    write_rows(options.json, rows)
    return 0


class Stepper:
    """Training steps of a configuration on made-up demonstrations, compiled; a call makes one."""

    def __init__(self, config: Config, mesh: Mesh) -> None:
        level = levels.find_level(config.level)
        self.sizes = pretrained.sizes_for(level, config.context, config.planner.horizon)
        self._config, self._words = config, level.words
        agent = self._agent(mesh)
        self.state, self._key = training.make_begin(agent, mesh)(0)
        self._data = sharding.replicate(random_steps(self.sizes, level.words), mesh)
        self._compiled = self._lower(agent).compile()

    def __call__(self) -> jax.Array:
        """Makes one step; its loss."""
        self.state, metrics = self._compiled(self.state, self._data, self._key)
        return metrics["loss"]

    def flops(self) -> float:
        """Of one step, counted by XLA for the whole batch on one device."""
        return self._lower(self._agent(None)).cost_analysis()["flops"]

    def _agent(self, mesh: Mesh | None) -> Agent:
        c = self._config
        return leap.make_agent(c.model, c.training, c.planner, self.sizes, self._words, mesh)

    def _lower(self, agent: Agent) -> Any:
        step = training.make_train_step(
            agent, lambda k, d: leap.make_batch(k, d, self._config.training, self.sizes)
        )
        return step.lower(self.state, self._data, self._key)  # type: ignore[attr-defined]


def measure(config: Config, seconds: float) -> Row:
    """One preset on one level."""
    batch = config.training.batch
    mesh = sharding.make_mesh(batch)
    step = Stepper(config, mesh)
    sizes = step.sizes
    taken = fastest(lambda: [step() for _ in range(5)], seconds) / 5
    encoder = encoder_seconds(config, sizes, step.state.params, batch, seconds)
    flops = step.flops()
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
    words = levels.find_level(config.level).words
    contexts = jax.tree.map(np.asarray, random_contexts(sizes, batch, words))
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
