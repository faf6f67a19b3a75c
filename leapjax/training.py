"""The training loop: a jitted pure step, and a loop around it with all side effects."""

import dataclasses
import math
import time
from collections.abc import Callable

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding

from leapjax import sharding
from leapjax.types import Agent, PyTree, TrainState

BATCH_STREAM, UPDATE_STREAM = 0, 1
# Steps that may be queued: enough to keep a device busy. On several CPU devices JAX 0.10 deadlocks
# if more than 32 programs are queued: the thread that should run the other half of an exchange
# waits for room in the queue.
AHEAD = 4


class NonFiniteLoss(RuntimeError):
    """Training met a loss or a gradient that is not a finite number."""


def make_begin(agent: Agent, mesh: Mesh) -> Callable[[int], tuple[TrainState, jax.Array]]:
    """Makes a jitted `(seed) -> (state, key)`: the first state of a run, and the key of its steps.

    Both are placed on the mesh; `sharding.parameter_specs` says how the state is split.
    """

    def begin(seed: jax.Array) -> tuple[TrainState, jax.Array]:
        key = jax.random.key(seed)
        return agent.init(key), key

    state, _ = jax.eval_shape(begin, 0)
    places = sharding.parameter_shardings(state, mesh), NamedSharding(mesh, sharding.REPLICATED)
    # The program runs once: optimising it would cost more time than it saves.
    return jax.jit(
        begin, out_shardings=places, compiler_options=sharding.choose_quick_options(mesh)
    )


@dataclasses.dataclass(frozen=True)
class TrainStep:
    """One step `(state, data, key) -> (state, metrics)`, as two jitted programs.

    Batch k and its noise are functions of (key, k) alone, where k is `state.step`. So a stopped and
    resumed run equals an uninterrupted run.

    Attributes:
        draw: (key, step, data) -> batch.
        update: (state, batch, key) -> (state, metrics); it consumes the state.
    """

    draw: Callable[[jax.Array, jax.Array, PyTree], PyTree]
    update: Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]

    def __call__(
        self, state: TrainState, data: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """Takes one step of training; it consumes `state`."""
        return self.update(state, self.draw(key, state.step, data), key)


def make_train_step(agent: Agent, mesh: Mesh | None = None) -> TrainStep:
    """Makes the programs of a step. `update`, slow to compile, serves any amount of data.

    Args:
        agent: agent to train.
        mesh: mesh that the agent was made with; `None` for one device. With a mesh, `make_begin`
            makes the state and the key, and `sharding.replicate` places the data.
    """

    def draw(key: jax.Array, step: jax.Array, data: PyTree) -> PyTree:
        return agent.batch(jax.random.fold_in(jax.random.fold_in(key, BATCH_STREAM), step), data)

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        key = jax.random.fold_in(jax.random.fold_in(key, UPDATE_STREAM), state.step)
        return agent.update(state, batch, key)

    rows = None if mesh is None else NamedSharding(mesh, sharding.SPLIT)
    options = None if mesh is None else sharding.choose_core_options(mesh)
    return TrainStep(
        jax.jit(draw, out_shardings=rows),  # each device draws and augments its own rows
        jax.jit(update, donate_argnums=0, compiler_options=options),
    )


def compile_ahead(
    agent: Agent, mesh: Mesh, like: PyTree
) -> tuple[Callable[[int], tuple[TrainState, jax.Array]], TrainStep]:
    """Calls `make_begin` and `make_train_step`, and compiles the programs that compile slowly.

    Args:
        agent: agent made with the mesh.
        mesh: devices to train on.
        like: data of the right structure, of any amount.
    """
    begin, step = make_begin(agent, mesh), make_train_step(agent, mesh)
    begun = begin.lower(0)  # type: ignore[attr-defined]
    whole, rows = (NamedSharding(mesh, spec) for spec in (sharding.REPLICATED, sharding.SPLIT))

    def placed(tree: PyTree, places: PyTree) -> PyTree:
        return jax.tree.map(
            lambda leaf, place: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place),
            tree, places,
        )  # fmt: skip

    state, key = jax.eval_shape(begin, 0)
    batch = jax.eval_shape(step.draw, key, state.step, like)
    arguments = (
        placed(state, sharding.parameter_shardings(state, mesh)),
        placed(batch, jax.tree.map(lambda _: rows, batch)),
        placed(key, whole),
    )
    update = step.update.lower(*arguments)  # type: ignore[attr-defined]
    return begun.compile(), dataclasses.replace(step, update=update.compile())


def train(
    train_step: Callable[..., tuple[TrainState, dict[str, jax.Array]]],
    state: TrainState,
    choose_data: Callable[[int], PyTree],
    key: jax.Array,
    steps: int,
    report: Callable[[int, TrainState, dict[str, float]], bool | None],
    report_every: int = 20,
    report_seconds: float = math.inf,
) -> TrainState:
    """Trains until the state has seen `steps` steps, or `report` returns True.

    Args:
        train_step: a `TrainStep`, or a function with its signature.
        state: state to start from; consumed.
        choose_data: (number of earlier steps) -> the training data of a step, on the devices.
        key: key of the run.
        steps: number of steps in all, including the steps that `state` has seen.
        report: called with (step, state, mean metrics) every `report_every` steps and at
            the end. If it returns True, this step was the last.
        report_every: number of steps between reports.
        report_seconds: seconds after which a report comes earlier. It must be infinite if several
            processes share a run: they must report at the same steps, but their clocks differ.

    Raises:
        NonFiniteLoss: a loss or a gradient is not finite. The message names the step; the state of
            the last report was still good.
    """
    done = int(state.step)
    pending: list[dict[str, jax.Array]] = []
    stop, reported = False, time.perf_counter()
    while done < steps and not stop:
        state, metrics = train_step(state, choose_data(done), key)
        done += 1
        pending.append(metrics)
        if len(pending) > AHEAD:
            jax.block_until_ready(pending[-1 - AHEAD])
        long_ago = time.perf_counter() - reported > report_seconds
        if done % report_every == 0 or done == steps or long_ago:
            values = sharding.to_host(pending)
            for offset, value in enumerate(values):
                for name in ("loss", "gradient_norm"):
                    if not np.isfinite(value.get(name, 0.0)):
                        bad = done - len(values) + offset + 1
                        raise NonFiniteLoss(f"the {name} of step {bad} is {value[name]}")
            means = {name: float(np.mean([v[name] for v in values])) for name in values[0]}
            stop = bool(report(done, state, means))
            pending, reported = [], time.perf_counter()
    return state
