"""The training loop: a jitted pure step, and everything that has side effects around it."""

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
# Steps that may wait for their turn: enough to keep a device busy. On several CPU devices JAX
# 0.10 stops for ever where more than 32 programs wait: the thread that would run the other
# half of an exchange then waits for room to queue one more.
AHEAD = 4


class NonFiniteLoss(RuntimeError):
    """Training met a loss or a gradient that is not a finite number."""


def make_begin(agent: Agent, mesh: Mesh) -> Callable[[int], tuple[TrainState, jax.Array]]:
    """The jitted `(seed) -> (state, key)`: the first state of a run, and the key of its steps.

    Both are on the mesh, the state split as `sharding.parameter_specs` says.
    """

    def begin(seed: jax.Array) -> tuple[TrainState, jax.Array]:
        key = jax.random.key(seed)
        return agent.init(key), key

    state, _ = jax.eval_shape(begin, 0)
    places = sharding.parameter_shardings(state, mesh), NamedSharding(mesh, sharding.REPLICATED)
    # It runs once, so that what optimisation takes is never won back.
    return jax.jit(
        begin, out_shardings=places, compiler_options=sharding.choose_quick_options(mesh)
    )


@dataclasses.dataclass(frozen=True)
class TrainStep:
    """One step `(state, data, key) -> (state, metrics)`, as two jitted programs.

    Batch k and its noise are functions of (key, k) alone, k being the state's own step, so
    a run that is stopped and continued is the run that was not.
    """

    draw: Callable[[jax.Array, jax.Array, PyTree], PyTree]  # (key, step, data) -> batch
    update: Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]
    # (state, batch, key) -> (state, metrics); it consumes the state

    def __call__(
        self, state: TrainState, data: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """Makes one step; it consumes `state`."""
        return self.update(state, self.draw(key, state.step, data), key)


def make_train_step(agent: Agent, mesh: Mesh | None = None) -> TrainStep:
    """The programs of a step. The long one to compile, `update`, is the same whatever the data.

    Args:
        agent: what is trained.
        mesh: that the agent was made with. The state and the key then come from `make_begin`,
            and the data from `sharding.replicate`.
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
        jax.jit(draw, out_shardings=rows),  # each device draws, and augments, its own
        jax.jit(update, donate_argnums=0, compiler_options=options),
    )


def compile_ahead(
    agent: Agent, mesh: Mesh, like: PyTree
) -> tuple[Callable[[int], tuple[TrainState, jax.Array]], TrainStep]:
    """`make_begin` and `make_train_step` with all that is long to compile compiled.

    Args:
        agent: that was made with the mesh.
        mesh: to train on.
        like: data of the right structure; how much of them there is does not matter.
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
    data: PyTree,
    key: jax.Array,
    steps: int,
    report: Callable[[int, TrainState, dict[str, float]], bool | None],
    report_every: int = 20,
    report_seconds: float = math.inf,
) -> TrainState:
    """Runs until the state has seen `steps` steps, or `report` says stop.

    Args:
        train_step: a `TrainStep`, or anything of its signature.
        state: to start from; consumed.
        data: on device.
        key: of the run.
        steps: in all, the steps that `state` has seen included.
        report: called with (step, state, mean metrics) every `report_every` steps and at
            the end. If it returns True, this step was the last.
        report_every: steps.
        report_seconds: and whenever so many have passed since. Processes that share a run have
            their own clocks, and may not differ in when they report: there it is infinite.

    Raises:
        NonFiniteLoss: names the step; the state of the last report was still good.
    """
    done = int(state.step)
    pending: list[dict[str, jax.Array]] = []
    stop, reported = False, time.perf_counter()
    while done < steps and not stop:
        state, metrics = train_step(state, data, key)
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
