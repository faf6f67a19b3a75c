"""Encoders of frames: a context becomes tokens, for both architectures.

A state is a stack of the last four frames (Mnih et al., 2015). A context holds each frame once, and
the encoders stack the frames. The paper's encoder, `StateTokens`, makes a token for each state of a
context. Our encoder, `CurrentTokens`, makes a few tokens for the current state.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense
from leapjax.types import Context

STACK = 4  # frames in a state
# Kernel side, stride and features of each layer; features are multiples of the first layer's
# (paper, table 7).
Layers = tuple[tuple[int, int, int], ...]
LAYERS: Layers = ((8, 4, 1), (4, 2, 2), (3, 1, 2))
HALVED: Layers = ((4, 2, 1), *LAYERS[1:])  # for frames with sides of half the length
HIDDEN = 256  # units between features and tokens in our encoder
CHANGES = 10.0  # weight of changes between frames; the last frame has weight 1


def stack_frames(frames: jax.Array, count: int) -> jax.Array:
    """Stacks the last `count` states of frames `[F, 84, 84]`: `[count, 84, 84, 4]`."""
    missing = max(count + STACK - 1 - frames.shape[0], 0)
    frames = jnp.pad(frames, ((missing, 0), (0, 0), (0, 0)))[-(count + STACK - 1) :]
    return jnp.stack([frames[i : i + count] for i in range(STACK)], axis=-1)


def compute_changes(stacks: jax.Array) -> jax.Array:
    """Computes the last frame and the changes before it from stacks `[n, 84, 84, 4]`.

    Moving objects cover a few of thousands of pixels: a network that does not see changes learns
    hardly anything for a thousand steps. The result averages over two by two pixels.

    Returns:
        `[n, 42, 42, 4]`: the last frame, then the three changes, oldest first.
    """
    x = stacks.astype(jnp.float32) / 255
    x = jnp.concatenate([x[..., -1:], CHANGES * jnp.diff(x, axis=-1)], axis=-1)
    count, height, width, _ = x.shape
    return x.reshape(count, height // 2, 2, width // 2, 2, STACK).mean(axis=(2, 4))


def join_frames(context: Context) -> jax.Array:
    """Joins all frames of a context, oldest first: `[K + 1, 84, 84]`."""
    return jnp.concatenate([context.past, jnp.asarray(context.observation)[None]])


class Features(nn.Module):
    """The convolutions of the appendix: `[n, 84, 84, 4]` to `[n, 7 * 7 * 2 * features]`.

    Attributes:
        layers: kernel side, stride and multiple of `features` of each layer.
        features: features of the first convolution.
        dtype: type of the computation.
    """

    layers: Layers
    features: int
    dtype: Dtype

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:  # noqa: D102
        for index, (side, stride, times) in enumerate(self.layers):
            # XLA's convolution is faster here than a product over shifted copies.
            convolution = nn.Conv(
                times * self.features, (side, side), stride, "VALID", dtype=self.dtype,
                kernel_init=nn.initializers.he_normal(), name=f"convolution_{index}",
            )  # fmt: skip
            x = nn.relu(convolution(x))
        return x.reshape(x.shape[0], -1)


class StateTokens(Encoder):
    """A token for each state of a context: `[K + 1, D]`, as in the Decision Transformer.

    The first three states see black frames before the context, so `encode_next` encodes them again.

    Attributes:
        width: D, width of a token.
        features: features of the first convolution.
        dtype: type of the computation.
    """

    width: int
    features: int
    dtype: Dtype = jnp.float32

    def __call__(self, context: Context) -> jax.Array:  # noqa: D102
        return self.encode_next(context, None)

    @nn.compact
    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:  # noqa: D102
        frames = join_frames(context)
        cut = min(STACK - 1, len(frames) - 1)
        states = stack_frames(frames, len(frames))
        if known is not None:
            states = jnp.concatenate([states[:cut], states[-1:]])
        features = Features(LAYERS, self.features, self.dtype, name="features")(
            states.astype(self.dtype) / 255
        )
        tokens = jnp.tanh(dense(self.width, dtype=self.dtype, name="state")(features))
        if known is None:
            return tokens
        return jnp.concatenate([tokens[:-1], known[cut:], tokens[-1:]])


class CurrentTokens(Encoder):
    """A few tokens for the current state and the changes before it: `[tokens, D]`.

    Frames before an episode equal its first frame. Frames that a short context does not hold are
    black: without a past, every pixel of the frame has changed.

    Attributes:
        width: D, width of a token.
        features: features of the first convolution.
        tokens: number of tokens.
        dtype: type of the computation.
    """

    width: int
    features: int
    tokens: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:  # noqa: D102
        frames = join_frames(context)
        past = frames.shape[0] - 1
        known = jnp.maximum(jnp.arange(past + 1), past - context.step)
        read = Features(HALVED, self.features, self.dtype, name="features")
        features = read(compute_changes(stack_frames(frames[known], 1)))
        # A wide and normalised layer: the transformer needs positions as inputs.
        hidden = nn.Dense(
            HIDDEN, dtype=self.dtype, kernel_init=nn.initializers.he_normal(), name="hidden"
        )
        x = nn.relu(nn.LayerNorm(dtype=self.dtype, name="norm")(hidden(features[0])))
        state = dense(self.tokens * self.width, scale=HIDDEN**-0.5, dtype=self.dtype, name="state")
        return state(x).reshape(self.tokens, self.width)
