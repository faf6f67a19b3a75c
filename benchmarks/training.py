"""Training steps per second against this machine's limit: `python -m benchmarks.training`.

A step draws and augments a batch, takes the gradient and updates the parameters, as in a run. Grids
are random, because speed does not depend on them. Compilation is timed apart. FLOPs count the
matrix products of a step; the peak is measured in the same run. The parts of a step are compiled
one by one, so their sum leaves out the exchange between devices.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from rich.console import Console
from rich.table import Table

from benchmarks.flops import matmul_flops
from benchmarks.planning import random_contexts
from benchmarks.timing import Row, check_writable, fastest, matmul_peak, write_rows
from leapjax import pretrained, sharding, training
from leapjax.agents.optimizer import make_optimizer
from leapjax.configuration import AnyConfig, change, make_domain, specify
from leapjax.data.windows import Steps, concatenate
from leapjax.domain import Domain
from leapjax.errors import UserError
from leapjax.presets import find_preset
from leapjax.running import jax_setup, shell
from leapjax.types import Agent, Demonstration, PyTree

LEVELS = ("GoToLocalS7N5", "GoToObjMazeS4", "GoToObjMazeS7")
EPISODES, LENGTH = 100, 20  # of the random demonstrations


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure training."""

    levels: tuple[str, ...] = LEVELS
    """Levels to measure."""
    presets: tuple[str, ...] = ("leapjax", "paper")
    """Presets to measure."""
    microbatch: int | None = None
    """Windows whose loss a device computes at a time, 0 for all; default: the preset's."""
    json: Path | None = None
    """Write the rows here."""
    seconds: float = 3.0
    """Least time for each measurement."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes the rows to `--json`; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "benchmarks.training", given)
    return shell.run_program("benchmarks.training", given, lambda: run(options))


def run(options: Options) -> None:
    """Measures every level and preset.

    Raises:
        UserError: a level or preset is unknown, or the microbatch is invalid.
    """
    check_writable(options.json)
    jax_setup.start(cache=False)  # compile times are real
    configs = [
        find_preset("babyai", level, "leap", name)
        for level in options.levels
        for name in options.presets
    ]
    if options.microbatch is not None:
        changed = {"microbatch": options.microbatch}
        try:
            configs = [change(config, training=changed) for config in configs]
        except ValueError as error:
            raise UserError(f"--microbatch {options.microbatch}: {error}") from None
    rows = [measure(config, options.seconds) for config in configs]
    Console().print(table(rows))
    write_rows(options.json, rows)


class Stepper:
    """Compiled training steps of a configuration on random demonstrations; a call makes a step."""

    def __init__(self, config: AnyConfig, mesh: Mesh) -> None:
        self._config, self._domain = config, make_domain(config)
        agent = self._agent(mesh)
        self.energy = agent.energy
        self._data = sharding.replicate(random_steps(self._domain), mesh)
        begin, self._step = training.compile_ahead(agent, mesh, self._data)
        self.state, self._key = begin(0)
        jax.block_until_ready(self())  # the first step compiles the drawing of a batch

    def __call__(self) -> jax.Array:
        """Makes one step; returns its loss."""
        self.state, metrics = self._step(self.state, self._data, self._key)
        return metrics["loss"]

    def flops(self) -> float:
        """Counts the FLOPs of the matrix products of one update with the whole batch."""
        update = training.make_train_step(self._agent(None)).update
        return matmul_flops(update, self.state, self._draw(), self._key)

    def parts(self, mesh: Mesh, seconds: float) -> list[Row]:
        """Measures the parts of a step, each compiled by itself, on the devices of `mesh`."""
        config, params = self._config, self.state.params
        tokens = jnp.zeros((config.training.batch, config.planner.horizon), jnp.int32)
        contexts = random_contexts(self._domain, config.context, config.training.batch)
        split = NamedSharding(mesh, sharding.SPLIT)
        contexts, tokens = jax.device_put((contexts, tokens), split)
        encode = sharding.split_batches(lambda _, *given: self._encode(*given), mesh)
        memory = encode(None, params, contexts)
        optimizer = make_optimizer(config.training)
        optimize = jax.jit(
            lambda state: optimizer.update(state.params, state.optimizer, state.params)
        )
        return [
            _part("drawing and augmenting a batch", self._draw, (), seconds),
            _gradient("context to memory", self._encode, params, (contexts,), mesh, seconds),
            _gradient("actions to loss", self._loss, params, (memory, tokens), mesh, seconds),
            _part("optimizer", optimize, (self.state,), seconds),
        ]

    def _draw(self) -> PyTree:
        return self._step.draw(self._key, self.state.step, self._data)

    def _encode(self, params: PyTree, contexts: PyTree) -> PyTree:
        return jax.vmap(self.energy.encode, in_axes=(None, 0))(params, contexts)

    def _loss(self, params: PyTree, memory: PyTree, tokens: jax.Array) -> jax.Array:
        """Computes losses with one pass per window, or with one pass per action of a window."""

        def one(memory: PyTree, actions: jax.Array) -> jax.Array:
            if self._config.method_settings.masking == "each":
                return self.energy.total(params, memory, actions)
            positions = jnp.arange(actions.shape[0])
            return self.energy.conditional(params, memory, actions, positions)[:, 0].sum()

        return jax.vmap(one)(memory, tokens)

    def _agent(self, mesh: Mesh | None) -> Agent:
        return pretrained.make_agent(specify(self._config, 0, self._domain), self._domain, mesh)


def _part(name: str, run: Callable[..., Any], arguments: tuple[Any, ...], seconds: float) -> Row:
    jax.block_until_ready(run(*arguments))
    taken = fastest(partial(run, *arguments), seconds)
    return {"part": name, "ms": 1e3 * taken, "gflop": matmul_flops(run, *arguments) / 1e9}


def _gradient(
    name: str,
    function: Callable[..., PyTree],
    params: PyTree,
    batches: tuple[PyTree, ...],
    mesh: Mesh,
    seconds: float,
) -> Row:
    """Measures `function(params, *batches)` and its gradient; each device takes its own rows."""

    def gradient(_: None, params: PyTree, *batches: PyTree) -> PyTree:
        def total(params: PyTree, inputs: PyTree) -> jax.Array:
            given = jax.tree.map(lambda x, y: y if _is_float(x) else x, batches, inputs)
            return jax.tree.reduce(jnp.add, jax.tree.map(jnp.sum, function(params, *given)))

        inputs = jax.tree.map(lambda x: x if _is_float(x) else jnp.zeros(()), batches)
        # One row per device, so that the result is split as the batch is.
        found = jax.grad(total, argnums=(0, 1))(params, inputs)
        return jax.tree.map(lambda leaf: leaf[None], found)

    return _part(name, sharding.split_batches(gradient, mesh), (None, params, *batches), seconds)


def _is_float(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def measure(config: AnyConfig, seconds: float) -> Row:
    """Measures one preset on one level."""
    batch, windows = config.training.batch, config.training.consecutive
    mesh = sharding.make_mesh(batch // windows)
    step = Stepper(config, mesh)
    taken = fastest(lambda: [step() for _ in range(5)], seconds) / 5
    flops = step.flops()
    tokens = batch * config.planner.horizon
    peak = matmul_peak(tokens, config.model.width, seconds)
    return {
        "level": config.level,
        "preset": config.preset,
        "horizon": config.planner.horizon,
        "context": config.context,
        "batch": batch,
        "consecutive": windows,
        "devices": mesh.size,
        "steps_per_second": 1 / taken,
        "parts": step.parts(mesh, seconds) if windows == 1 else [],  # for windows drawn alone
        "flops_per_step": flops,
        "gflops": flops / taken / 1e9,
        "peak_gflops": peak,
        "fraction_of_peak": flops / taken / 1e9 / peak,
        "steps": config.training.steps,
        "training_seconds": config.training.steps * taken,
    }


def random_steps(domain: Domain) -> Steps:
    """Makes random demonstrations of the right shapes."""
    states = random_contexts(domain, 0, LENGTH + 1).observation
    choose = np.random.default_rng(0)
    played = [
        Demonstration(
            states, choose.integers(0, 3, LENGTH).astype(np.int32),
            np.zeros(LENGTH, np.float32), True, False, episode,
        )
        for episode in range(EPISODES)
    ]  # fmt: skip
    return concatenate(played, domain.augmentations.extras)


def table(rows: Sequence[Row]) -> Table:
    """Makes a table of the rows for a terminal."""
    result = Table("level", "preset", "steps/s", "ms/step", "GFLOP/s", "peak", "fraction", "in all")
    for row in rows:
        result.add_row(
            row["level"],
            row["preset"]
            + (f", {row['consecutive']} consecutive" if row["consecutive"] > 1 else ""),
            f"{row['steps_per_second']:.1f}",
            f"{1e3 / row['steps_per_second']:.1f}",
            f"{row['gflops']:.0f}",
            f"{row['peak_gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
            f"{row['training_seconds']:.0f} s",
        )
    return result


if __name__ == "__main__":
    sys.exit(main())
