"""The training loop: a jitted pure step, and everything that has side effects around it."""

from collections.abc import Callable

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding

from leapjax import sharding
from leapjax.types import Agent, PyTree, TrainState

BATCH_STREAM, UPDATE_STREAM = 0, 1


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
    return jax.jit(begin, out_shardings=places)


def make_train_step(
    agent: Agent,
) -> Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]:
    """The jitted step `(state, data, key) -> (state, metrics)`; it consumes `state`.

    Batch k and its noise are functions of (key, k) alone, k being the state's own step, so
    a run that is stopped and continued is the run that was not.

    Args:
        agent: what is trained. If it was made with a mesh, the state and the key come from
            `make_begin` with that mesh, and the data from `sharding.replicate`.
    """

    def step(
        state: TrainState, data: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        batch_key = jax.random.fold_in(jax.random.fold_in(key, BATCH_STREAM), state.step)
        update_key = jax.random.fold_in(jax.random.fold_in(key, UPDATE_STREAM), state.step)
        return agent.update(state, agent.batch(batch_key, data), update_key)

    return jax.jit(step, donate_argnums=0)


def train(
    train_step: Callable[..., tuple[TrainState, dict[str, jax.Array]]],
    state: TrainState,
    data: PyTree,
    key: jax.Array,
    steps: int,
    report: Callable[[int, TrainState, dict[str, float]], bool | None],
    report_every: int = 20,
) -> TrainState:
    """Runs until the state has seen `steps` steps, or `report` says stop.

    Args:
        train_step: from `make_train_step`, or anything of that signature.
        state: to start from; consumed.
        data: on device.
        key: of the run.
        steps: in all, the steps that `state` has seen included.
        report: called with (step, state, mean metrics) every `report_every` steps and at
            the end; only there does the loop wait for the device. If it returns True, this
            step was the last.
        report_every: steps.

    Raises:
        NonFiniteLoss: names the step; the state of the last report was still good.
    """
    done = int(state.step)
    pending: list[dict[str, jax.Array]] = []
    stop = False
    while done < steps and not stop:
        state, metrics = train_step(state, data, key)
        done += 1
        pending.append(metrics)
        if done % report_every == 0 or done == steps:
            values = sharding.to_host(pending)
            for offset, value in enumerate(values):
                for name in ("loss", "gradient_norm"):
                    if not np.isfinite(value.get(name, 0.0)):
                        bad = done - len(values) + offset + 1
                        raise NonFiniteLoss(f"the {name} of step {bad} is {value[name]}")
            means = {name: float(np.mean([v[name] for v in values])) for name in values[0]}
            stop = bool(report(done, state, means))
            pending = []
    return state
