"""Encoders of frames: a context to tokens, for both architectures.

A state is a stack of the last four frames (Mnih et al., 2015). A context holds each frame once,
so that stacks are made here: the first three states of a context see black frames before it.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

from leapjax.models.transformer import dense
from leapjax.types import Context

STACK = 4  # frames that a state is made of
# Side and stride of each layer, and its features in those of the first (paper, table 6).
LAYERS = ((8, 4, 1), (4, 2, 2), (3, 1, 2))


def stacked(frames: jax.Array, count: int) -> jax.Array:
    """The last `count` states of frames `[F, 84, 84]`, oldest first: `[count, 84, 84, 4]`."""
    missing = max(count + STACK - 1 - frames.shape[0], 0)
    frames = jnp.pad(frames, ((missing, 0), (0, 0), (0, 0)))[-(count + STACK - 1) :]
    return jnp.stack([frames[i : i + count] for i in range(STACK)], axis=-1)


def seen(context: Context) -> jax.Array:
    """All frames of a context, oldest first: `[K + 1, 84, 84]`."""
    return jnp.concatenate([context.past, jnp.asarray(context.observation)[None]])


class Features(nn.Module):
    """The convolutions of the appendix: stacks `[n, 84, 84, 4]` to `[n, 7 * 7 * 2 * features]`."""

    features: int
    dtype: Dtype

    @nn.compact
    def __call__(self, stacks: jax.Array) -> jax.Array:  # noqa: D102
        x = stacks.astype(self.dtype) / 255
        for index, (side, stride, times) in enumerate(LAYERS):
            # XLA's own is faster here than a product over shifted copies (docs/tried.md).
            convolution = nn.Conv(
                times * self.features, (side, side), stride, "VALID", dtype=self.dtype,
                kernel_init=nn.initializers.he_normal(), name=f"convolution_{index}",
            )  # fmt: skip
            x = nn.relu(convolution(x))
        return x.reshape(x.shape[0], -1)


class StateTokens(nn.Module):
    """A token for each state of a context: `[K + 1, D]`, as Decision Transformer has it."""

    width: int
    features: int  # of the first convolution
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:  # noqa: D102
        frames = seen(context)
        features = Features(self.features, self.dtype, name="features")(
            stacked(frames, frames.shape[0])
        )
        return jnp.tanh(dense(self.width, dtype=self.dtype, name="state")(features))


class CurrentTokens(nn.Module):
    """A few tokens for the current state alone: `[tokens, D]`."""

    width: int
    features: int  # of the first convolution
    tokens: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:  # noqa: D102
        features = Features(self.features, self.dtype, name="features")(stacked(seen(context), 1))
        scale = features.shape[-1] ** -0.5
        read = dense(self.tokens * self.width, scale=scale, dtype=self.dtype, name="state")
        return read(features[0]).reshape(self.tokens, self.width)
