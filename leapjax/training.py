"""The training loop: a jitted pure step, and everything that has side effects around it."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from leapjax import sharding
from leapjax.types import Agent, PyTree, TrainState

BATCH_STREAM, UPDATE_STREAM = 0, 1


class NonFiniteLoss(RuntimeError):
    """Training met a loss or a gradient that is not a finite number."""


def make_train_step(
    agent: Agent, make_batch: Callable[[jax.Array, PyTree], PyTree], mesh: Mesh | None = None
) -> Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]:
    """The jitted step `(state, data, key) -> (state, metrics)`; it consumes `state`.

    Batch k and its noise are functions of (key, k) alone, k being the state's own step, so
    a run that is stopped and continued is the run that was not.

    Args:
        agent: what is trained.
        make_batch: (key, data) -> batch; pure.
        mesh: splits every batch over its devices; the state is on all of them (see
            `sharding.replicate`) and `agent` averages over the axis `sharding.DATA`. None
            for one device.

    Raises:
        ValueError: the agent averages over another axis than the mesh has.
    """
    wanted = None if mesh is None else sharding.DATA
    if agent.axis != wanted:
        raise ValueError(
            f"the agent averages gradients over axis {agent.axis!r}, but with "
            f"{'no mesh' if mesh is None else 'a mesh'} that must be {wanted!r}: make it with "
            f"axis={wanted!r}"
        )
    update = agent.update
    if mesh is not None:
        everywhere, split = sharding.REPLICATED, sharding.SPLIT
        update = jax.shard_map(
            update, mesh=mesh, in_specs=(everywhere, split, everywhere), out_specs=everywhere,
            check_vma=False,  # the mean over devices is taken by the agent
        )  # fmt: skip

    def step(
        state: TrainState, data: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        batch_key = jax.random.fold_in(jax.random.fold_in(key, BATCH_STREAM), state.step)
        update_key = jax.random.fold_in(jax.random.fold_in(key, UPDATE_STREAM), state.step)
        return update(state, make_batch(batch_key, data), update_key)

    return jax.jit(step, donate_argnums=0)


def train(
    train_step: Callable[..., tuple[TrainState, dict[str, jax.Array]]],
    state: TrainState,
    data: PyTree,
    key: jax.Array,
    steps: int,
    report: Callable[[int, TrainState, dict[str, float]], Any],
    report_every: int = 20,
    stop: Callable[[], bool] = lambda: False,
) -> TrainState:
    """Runs until the state has seen `steps` steps, or `stop` says so.

    Args:
        train_step: from `make_train_step`, or anything of that signature.
        state: to start from; consumed.
        data: on device.
        key: of the run.
        steps: in all, the steps that `state` has seen included.
        report: called with (step, state, mean metrics) every `report_every` steps and at
            the end; only there does the loop wait for the device.
        report_every: steps.
        stop: asked after every step; if it says yes, this step is reported and the last.

    Raises:
        NonFiniteLoss: names the step; the state of the last report was still good.
    """
    done = int(state.step)
    pending: list[dict[str, jax.Array]] = []
    stopping = False
    while done < steps and not stopping:
        state, metrics = train_step(state, data, key)
        done += 1
        pending.append(metrics)
        stopping = stop()
        if done % report_every == 0 or done == steps or stopping:
            values = jax.device_get(pending)
            for offset, value in enumerate(values):
                for name in ("loss", "gradient_norm"):
                    if not np.isfinite(value.get(name, 0.0)):
                        bad = done - len(values) + offset + 1
                        raise NonFiniteLoss(f"the {name} of step {bad} is {value[name]}")
            means = {name: float(np.mean([v[name] for v in values])) for name in values[0]}
            report(done, state, means)
            pending = []
    return state
