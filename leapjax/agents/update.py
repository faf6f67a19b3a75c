"""The training state of an agent: how it begins, and one gradient step on all devices."""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax import sharding
from leapjax.agents.base import Setup
from leapjax.agents.batch_loss import BatchLoss
from leapjax.domain import blank_context
from leapjax.types import Context, Params, PyTree, TrainState

Update = Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]


def apply_to_context(module: nn.Module, context: Context, actions: jax.Array) -> PyTree:
    """Applies a network to a context, which uses every parameter: a `touch` of `make_init`."""
    del actions
    return module(context)


def make_init(
    setup: Setup,
    module: nn.Module,
    touch: Callable[..., PyTree],
    optimizer: optax.GradientTransformation,
    target: Callable[[Params], PyTree] = lambda params: (),
) -> Callable[[jax.Array], TrainState]:
    """Makes an agent's `init`: (key) -> the state before the first step.

    Args:
        setup: arguments of `make_agent`.
        module: network.
        touch: (module, context, actions `[T]`) -> anything; must use every parameter.
        optimizer: optimizer of the parameters.
        target: (params) -> parameters of the target network, which become the state's `extra`.
    """

    def init(key: jax.Array) -> TrainState:
        context = jax.tree.map(jnp.asarray, blank_context(setup.domain, setup.context))
        actions = jnp.zeros(setup.horizon, jnp.int32)
        params = module.init(key, context, actions, method=touch)
        # A copy: a state that is updated in place must hold each array once.
        extra = jax.tree.map(jnp.copy, target(params))
        return TrainState(params, optimizer.init(params), jnp.int32(0), extra)

    return init


def make_update(
    batch_loss: BatchLoss,
    optimizer: optax.GradientTransformation,
    mesh: Mesh | None = None,
    next_extra: Callable[[PyTree, Params], PyTree] = lambda extra, params: extra,
) -> Update:
    """Makes an agent's `update`: (state, batch, key) -> the next state, and metrics.

    Args:
        batch_loss: loss of the examples of one device.
        optimizer: optimizer of the parameters.
        mesh: devices that split the batch, and the state by `sharding.parameter_specs`; `None` for
            one device.
        next_extra: (extra, new parameters) -> the state's `extra` after the step.
    """

    def differentiate(
        params: Params, extra: PyTree, batch: PyTree, key: jax.Array, first: jax.Array | int
    ) -> PyTree:
        """Returns ((loss, metrics), gradients) of the examples of one device."""
        # An example's key depends on its index in the whole batch, so devices do not change it.
        indices = first + jnp.arange(jax.tree.leaves(batch)[0].shape[0])
        keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(indices)
        return jax.value_and_grad(batch_loss, has_aux=True)(params, extra, batch, keys)

    def mean_gradient(params: Params, extra: PyTree, batch: PyTree, key: jax.Array) -> PyTree:
        """Returns ((loss, metrics), gradients) of the whole batch."""
        if mesh is None:
            return differentiate(params, extra, batch, key, 0)
        specs = sharding.parameter_specs(params, mesh)
        extra_specs = sharding.parameter_specs(extra, mesh)

        def on_each_device(parts: Params, extra: PyTree, rows: PyTree, key: jax.Array) -> PyTree:
            first = jax.lax.axis_index(sharding.AXES) * jax.tree.leaves(rows)[0].shape[0]
            whole = sharding.gather(parts, specs), sharding.gather(extra, extra_specs)
            means, gradients = differentiate(*whole, rows, key, first)
            return jax.lax.pmean(means, sharding.AXES), sharding.scatter_mean(gradients, specs)

        return jax.shard_map(
            on_each_device, mesh=mesh, check_vma=False,
            in_specs=(specs, extra_specs, sharding.SPLIT, sharding.REPLICATED),
            out_specs=(sharding.REPLICATED, specs),
        )(params, extra, batch, key)  # fmt: skip

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        (loss, metrics), gradients = mean_gradient(state.params, state.extra, batch, key)
        updates, opt_state = optimizer.update(gradients, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        norm = optax.tree.norm(gradients)
        extra = next_extra(state.extra, params)
        state = TrainState(params, opt_state, state.step + 1, extra)
        if mesh is not None:  # the same shardings as before, so the next step needs no compilation
            shardings = sharding.parameter_shardings(state, mesh)
            state = jax.lax.with_sharding_constraint(state, shardings)
        return state, {"loss": loss, **metrics, "gradient_norm": norm}

    return update


def follow_parameters(
    rate: float, select: Callable[[Params], PyTree] = lambda params: params
) -> Callable[[PyTree, Params], PyTree]:
    """Makes the `next_extra` of a slowly moving target network (Lillicrap et al., 2016).

    Args:
        rate: share of the distance to the network's parameters that a step covers, in 0 .. 1.
        select: (params) -> the parameters to follow.
    """

    def step(target: PyTree, params: Params) -> PyTree:
        return optax.incremental_update(select(params), target, rate)

    return step
