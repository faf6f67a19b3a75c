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
from experiments.common import program, runtime
from experiments.common.config import Config, make_domain, preset, specify
from leapjax import pretrained, sharding, training
from leapjax.data.windows import Steps, concatenate
from leapjax.domain import Domain
from leapjax.types import Agent, Demonstration, PyTree

LEVELS = ("GoToLocalS7N5", "GoToObjMazeS4", "GoToObjMazeS7")
EPISODES, LENGTH = 100, 20  # of the made-up demonstrations


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure training."""

    levels: tuple[str, ...] = LEVELS
    """Whose settings to measure: horizon, context, grid."""
    presets: tuple[str, ...] = ("leapjax", "paper")
    """Which presets."""
    json: Path | None = None
    """Write the rows here."""
    seconds: float = 3.0
    """Time to spend on each measurement, at least."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes what was asked for."""
    given = program.arguments_of(arguments)
    options = tyro.cli(Options, args=given)
    return program.guarded("benchmarks.training", given, lambda: run(options))


def run(options: Options) -> None:
    """Measures every level and preset."""
    runtime.use_every_core()  # and no compilation cache: compile times are real
    configs = [
        preset("babyai", level, "leap", name)
        for level in options.levels
        for name in options.presets
    ]
    rows = [measure(config, options.seconds) for config in configs]
    Console().print(table(rows))
    write_rows(options.json, rows)


class Stepper:
    """Training steps of a configuration on made-up demonstrations, compiled; a call makes one."""

    def __init__(self, config: Config[Any, Any], mesh: Mesh) -> None:
        self._config, self._domain = config, make_domain(config)
        agent = self._agent(mesh)
        self.energy = agent.energy
        self._data = sharding.replicate(random_steps(self._domain), mesh)
        begin, self._step = training.compile_ahead(agent, mesh, self._data)
        self.state, self._key = begin(0)
        jax.block_until_ready(self())  # the draw of a batch is compiled on first use

    def __call__(self) -> jax.Array:
        """Makes one step; its loss."""
        self.state, metrics = self._step(self.state, self._data, self._key)
        return metrics["loss"]

    def flops(self) -> float:
        """Of one update, counted by XLA for the whole batch on one device."""
        step = training.make_train_step(self._agent(None))
        arguments = self.state, jax.eval_shape(step.draw, self._key, 0, self._data), self._key
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), arguments)
        return step.update.lower(*shapes).cost_analysis()["flops"]  # type: ignore[attr-defined]

    def encoder_seconds(self, mesh: Mesh, seconds: float) -> float:
        """Seconds for the encoder of a batch and its gradient, on as many devices."""

        def gradient(_: None, params: PyTree, contexts: PyTree) -> PyTree:
            def total(params: PyTree) -> jax.Array:
                memory = jax.vmap(self.energy.encode, in_axes=(None, 0))(params, contexts)
                return jax.tree.reduce(jnp.add, jax.tree.map(jnp.sum, memory))

            # One row per device, so that the result is split as the batch is.
            return jax.tree.map(lambda leaf: leaf[None], jax.grad(total)(params))

        run = partial(sharding.split_batches(gradient, mesh), None)
        config = self._config
        contexts = random_contexts(self._domain, config.context, config.training.batch)
        contexts = jax.tree.map(np.asarray, contexts)
        jax.block_until_ready(run(self.state.params, contexts))
        return fastest(partial(run, self.state.params, contexts), seconds)

    def _agent(self, mesh: Mesh | None) -> Agent:
        return pretrained.make_agent(specify(self._config, 0, self._domain), self._domain, mesh)


def measure(config: Config[Any, Any], seconds: float) -> Row:
    """One preset on one level."""
    batch = config.training.batch
    mesh = sharding.make_mesh(batch)
    step = Stepper(config, mesh)
    taken = fastest(lambda: [step() for _ in range(5)], seconds) / 5
    encoder = step.encoder_seconds(mesh, seconds)
    flops = step.flops()
    tokens = batch * config.planner.horizon
    peak = matmul_peak(tokens, config.model.width, seconds)
    return {
        "level": config.level,
        "preset": config.preset,
        "horizon": config.planner.horizon,
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


def random_steps(domain: Domain) -> Steps:
    """Demonstrations of the right shapes, of nothing in particular."""
    contexts = random_contexts(domain, 0, LENGTH + 1)
    states = jax.tree.map(np.asarray, contexts.observation)
    choose = np.random.default_rng(0)
    played = [
        Demonstration(
            states, choose.integers(0, 3, LENGTH).astype(np.int32),
            np.zeros(LENGTH, np.float32), True, False, episode,
        )
        for episode in range(EPISODES)
    ]  # fmt: skip
    return concatenate(played, domain.extras)


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
