"""One gradient step on a mean over examples, on one device or on many: what agents share."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from leapjax.types import Params, PyTree, TrainState

ExampleLoss = Callable[[Params, PyTree, jax.Array], tuple[jax.Array, dict[str, jax.Array]]]
# (params, example, key) -> loss [] and metrics
Update = Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]


def make_update(
    example_loss: ExampleLoss, optimizer: optax.GradientTransformation, axis: str | None = None
) -> Update:
    """An agent's `update`: the loss and the metrics are means over the batch.

    Args:
        example_loss: of one example.
        optimizer: turns gradients into updates.
        axis: the mesh axis that batches are split over, inside `jax.shard_map`; None
            outside of it.
    """

    def batch_loss(
        params: Params, batch: PyTree, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        # Keys by place in the whole batch: however it is split, an example meets its own.
        count = jax.tree.leaves(batch)[0].shape[0]
        places = jnp.arange(count) + (0 if axis is None else count * jax.lax.axis_index(axis))
        keys = jax.vmap(lambda place: jax.random.fold_in(key, place))(places)
        losses, metrics = jax.vmap(example_loss, in_axes=(None, 0, 0))(params, batch, keys)
        return losses.mean(), jax.tree.map(jnp.mean, metrics)

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        result = jax.value_and_grad(batch_loss, has_aux=True)(state.params, batch, key)
        if axis is not None:
            result = jax.lax.pmean(result, axis)
        (loss, metrics), gradients = result
        updates, opt_state = optimizer.update(gradients, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        norm = optax.global_norm(gradients)
        metrics = {"loss": loss, **metrics, "gradient_norm": norm}
        return TrainState(params, opt_state, state.step + 1), metrics

    return update
