"""The loss of a batch: the mean of its examples' losses, computed a few examples at a time."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.agents.base import Setup
from leapjax.types import Params, PyTree, Window

BatchLoss = Callable[
    [Params, PyTree, PyTree, jax.Array], tuple[jax.Array, dict[str, jax.Array]]
]  # (params, extra, batch [B, ...], keys [B]) -> loss [] and metrics, means over the batch
EncodeExamples = Callable[[Params, PyTree, PyTree], PyTree]
# (params, extra, batch [B, ...]) -> tokens [B, ...] of the examples' contexts
ExampleLoss = Callable[
    [Params, PyTree, PyTree, PyTree, jax.Array], tuple[jax.Array, dict[str, jax.Array]]
]  # (params, extra, example, its tokens, key) -> loss [] and metrics


def average_loss(setup: Setup, example_loss: ExampleLoss, encode: EncodeExamples) -> BatchLoss:
    """Makes the loss of a batch from the loss of one example.

    The encoder reads all contexts of a device at once, because matrix products with few rows are
    slow (docs/performance.md). The loss then takes `TrainingConfig.microbatch` examples at a time.

    Args:
        setup: arguments of `make_agent`.
        example_loss: loss of one example, given the tokens of its context.
        encode: encodes the contexts of a batch.
    """

    def examples_loss(
        params: Params, tokens: PyTree, extra: PyTree, rows: tuple[PyTree, jax.Array]
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        each = jax.vmap(example_loss, in_axes=(None, None, 0, 0, 0))
        examples, keys = rows
        return jax.tree.map(jnp.mean, each(params, extra, examples, tokens, keys))

    in_microbatches = _split_into_microbatches(examples_loss, setup.training.microbatch)

    def batch_loss(
        params: Params, extra: PyTree, batch: PyTree, keys: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        return in_microbatches(params, encode(params, extra, batch), extra, (batch, keys))

    return batch_loss


def _split_into_microbatches(loss: Callable[..., Any], most: int) -> Callable[..., Any]:
    """Makes a function with the values and gradients of `loss` that needs less memory.

    It computes the value and the gradient of a microbatch before the next one, and adds them up.

    Args:
        loss: (params, tokens `[B, ...]`, extra, rows `[B, ...]`) -> loss `[]` and metrics, means
            over the B examples. The gradients are with respect to params and tokens.
        most: largest number of examples in a microbatch; 0 for all B.
    """
    differentiate = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)

    @jax.custom_vjp
    def mean(*inputs: PyTree) -> PyTree:
        return forward(*inputs)[0]

    def forward(
        params: Params, tokens: PyTree, extra: PyTree, rows: PyTree
    ) -> tuple[PyTree, tuple[Params, PyTree]]:
        size = jax.tree.leaves(rows)[0].shape[0]
        count = next(count for count in range(-(-size // most), size + 1) if size % count == 0)
        parts = jax.tree.map(
            lambda x: x.reshape(count, size // count, *x.shape[1:]), (tokens, rows)
        )

        def add(totals: PyTree, part: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
            means, (gradient, by_tokens) = differentiate(params, part[0], extra, part[1])
            return jax.tree.map(jnp.add, totals, (means, gradient)), by_tokens

        one = jax.tree.map(lambda x: x[0], parts)
        means, (gradient, _) = jax.eval_shape(differentiate, params, one[0], extra, one[1])
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (means, gradient))
        sums = jax.lax.scan(add, zeros, parts)
        (means, gradient), by_tokens = jax.tree.map(lambda x: x / count, sums)
        return means, (gradient, jax.tree.map(lambda x, y: x.reshape(y.shape), by_tokens, tokens))

    def backward(gradients: PyTree, cotangents: PyTree) -> tuple[PyTree, ...]:
        return *jax.tree.map(lambda x: cotangents[0] * x, gradients), None, None

    mean.defvjp(forward, backward)
    return mean if most else loss


def make_window_encoder(module: nn.Module) -> EncodeExamples:
    """Makes the `encode` of `average_loss` for batches of windows.

    Args:
        module: network with `encode_batch`.
    """

    def encode(params: Params, extra: PyTree, batch: Window) -> PyTree:
        del extra
        return module.apply(params, batch.context, method="encode_batch")

    return encode
