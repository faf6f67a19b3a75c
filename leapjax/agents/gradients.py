"""One gradient step on a mean over examples, on one device or on many: what agents share."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax import sharding
from leapjax.types import Params, PyTree, TrainState

ExampleLoss = Callable[[Params, PyTree, jax.Array], tuple[jax.Array, dict[str, jax.Array]]]
# (params, example, key) -> loss [] and metrics
Update = Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]


def make_update(
    example_loss: ExampleLoss, optimizer: optax.GradientTransformation, mesh: Mesh | None = None
) -> Update:
    """An agent's `update`: the loss and the metrics are means over the batch.

    Args:
        example_loss: of one example.
        optimizer: turns gradients into updates.
        mesh: splits every batch, and the state as `sharding.parameter_specs` says; None for
            one device.
    """

    def batch_loss(
        params: Params, batch: PyTree, key: jax.Array, first: jax.Array | int
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        # Keys by place in the whole batch: however it is split, an example meets its own.
        places = first + jnp.arange(jax.tree.leaves(batch)[0].shape[0])
        keys = jax.vmap(lambda place: jax.random.fold_in(key, place))(places)
        losses, metrics = jax.vmap(example_loss, in_axes=(None, 0, 0))(params, batch, keys)
        return losses.mean(), jax.tree.map(jnp.mean, metrics)

    differentiate = jax.value_and_grad(batch_loss, has_aux=True)

    def mean_gradient(params: Params, batch: PyTree, key: jax.Array) -> PyTree:
        """((loss, metrics), gradients) of a batch."""
        if mesh is None:
            return differentiate(params, batch, key, 0)
        specs = sharding.parameter_specs(params, mesh)

        def on_each_device(parts: Params, rows: PyTree, key: jax.Array) -> PyTree:
            first = jax.lax.axis_index(sharding.AXES) * jax.tree.leaves(rows)[0].shape[0]
            means, gradients = differentiate(sharding.gather(parts, specs), rows, key, first)
            return jax.lax.pmean(means, sharding.AXES), sharding.scatter_mean(gradients, specs)

        return jax.shard_map(
            on_each_device, mesh=mesh, check_vma=False,
            in_specs=(specs, sharding.SPLIT, sharding.REPLICATED),
            out_specs=(sharding.REPLICATED, specs),
        )(params, batch, key)  # fmt: skip

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        (loss, metrics), gradients = mean_gradient(state.params, batch, key)
        updates, opt_state = optimizer.update(gradients, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        norm = optax.global_norm(gradients)
        state = TrainState(params, opt_state, state.step + 1)
        if mesh is not None:  # where it was: the next step is then the same program
            places = sharding.parameter_shardings(state, mesh)
            state = jax.lax.with_sharding_constraint(state, places)
        return state, {"loss": loss, **metrics, "gradient_norm": norm}

    return update
