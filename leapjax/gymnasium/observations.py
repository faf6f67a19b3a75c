"""What observations of a Gymnasium environment are made of, and a network that reads them."""

from typing import NamedTuple

import flax.linen as nn
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import Dtype

from leapjax.errors import UserError
from leapjax.models.transformer import dense, embed
from leapjax.types import Context, PyTree

SCALES = (0.01, 0.1, 1.0, 10.0)  # that numbers are looked at in: nobody says how large they are
SMALL = 12  # pixels: an image is halved until no side is longer
FEATURES = 32  # of an image's first layer; the others have twice as many


class Part(NamedTuple):
    """One array of an observation."""

    kind: str  # "numbers", "image" or "choices"
    choices: int = 0  # of each number, where they are choices
    first: int = 0  # the least of them, where that is below 0


def blank_of(space: gym.Space, name: str) -> PyTree:
    """An observation of zeros.

    Raises:
        UserError: a space that no network here can read.
    """
    if isinstance(space, gym.spaces.Dict):
        return {key: blank_of(space[key], f"{name}[{key!r}]") for key in sorted(space.spaces)}
    if isinstance(space, gym.spaces.Discrete):
        return np.zeros((), np.int64)
    arrays = (gym.spaces.Box, gym.spaces.MultiDiscrete, gym.spaces.MultiBinary)
    if isinstance(space, arrays):
        return np.zeros(space.shape, space.dtype)
    raise UserError(
        f"{name} is a {type(space).__name__}: expected Box, Discrete, MultiDiscrete, MultiBinary, "
        "or a Dict of those; a wrapper of Gymnasium can make one of another space"
    )


def parts_of(space: gym.Space) -> tuple[Part, ...]:
    """The arrays of an observation, in the order of `jax.tree.leaves`."""
    if isinstance(space, gym.spaces.Dict):
        return tuple(part for key in sorted(space.spaces) for part in parts_of(space[key]))
    if isinstance(space, gym.spaces.Discrete):
        return (_choices(int(space.start), int(space.start + space.n)),)
    if isinstance(space, gym.spaces.MultiDiscrete):
        return (_choices(int(space.start.min()), int((space.start + space.nvec).max())),)
    picture = len(space.shape or ()) == 3 and space.dtype == np.uint8
    return (Part("image" if picture else "numbers"),)


def _choices(start: int, end: int) -> Part:
    """Choices in `start` .. `end - 1`, or those that are counted from 0."""
    first = min(start, 0)
    return Part("choices", end - first, first)


def check_choices(space: gym.Space, observations: PyTree, where: str) -> None:
    """Refuses choices that there are not: a network would see none instead.

    Args:
        space: of one observation.
        observations: any number of them, `[n, ...]`.
        where: they are from.

    Raises:
        UserError: says which.
    """
    if isinstance(space, gym.spaces.Dict):
        for key, part in space.spaces.items():
            check_choices(part, observations[key], f"{where}: {key}")
        return
    if isinstance(space, gym.spaces.Discrete):
        first, last = space.start, space.start + space.n - 1
    elif isinstance(space, gym.spaces.MultiDiscrete):
        first, last = space.start, space.start + space.nvec - 1
    else:
        return
    wrong = (observations < first) | (observations > last)
    if wrong.any():
        at = tuple(np.argwhere(wrong)[0])
        low, high = (np.broadcast_to(each, observations.shape)[at] for each in (first, last))
        raise UserError(f"{where}: a choice of {observations[at]}, expected {low} to {high}")


class StateTokens(nn.Module):
    """A token for each state of a context: `[K + 1, D]`, the current state last."""

    parts: tuple[Part, ...]
    width: int
    num_actions: int  # A; 0: what was done is not for this module to say, nor when
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:
        """Tokens of the K past states and the current one."""
        current = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], context.observation)
        known = () if context.encoded is None else (context.encoded,)
        states = current
        if not known:
            states = jax.tree.map(lambda *both: jnp.concatenate(both), context.past, current)
        leaves = jax.tree.leaves(states)  # each [K + 1, ...], or [1, ...]
        read = [
            getattr(self, f"_{part.kind}")(leaf, part, str(index))
            for index, (part, leaf) in enumerate(zip(self.parts, leaves, strict=True))
        ]
        tokens = nn.gelu(sum(read, jnp.zeros((len(leaves[0]), self.width))))
        tokens = self._dense(nn.gelu(self._dense(tokens, "mixed")), "token")
        tokens = jnp.concatenate([*known, tokens])
        if not self.num_actions:
            return tokens
        count = tokens.shape[0]
        done = embed(self.num_actions + 2, self.width, name="action")(context.actions)
        tokens = tokens.at[:-1].add(done)
        return tokens + embed(count, self.width, name="place")(jnp.arange(count))

    def _dense(self, x: jax.Array, name: str) -> jax.Array:
        scale = x.shape[-1] ** -0.5
        return dense(self.width, scale=scale, name=name, dtype=self.dtype)(x)

    def _numbers(self, leaf: jax.Array, part: Part, name: str) -> jax.Array:
        flat = leaf.reshape(leaf.shape[0], -1).astype(jnp.float32)
        scaled = jnp.concatenate([jnp.tanh(flat / scale) for scale in SCALES], axis=1)
        return self._dense(scaled, f"numbers_{name}")

    def _choices(self, leaf: jax.Array, part: Part, name: str) -> jax.Array:
        chosen = jax.nn.one_hot(leaf - part.first, part.choices).reshape(leaf.shape[0], -1)
        return self._dense(chosen, f"choices_{name}")

    def _image(self, leaf: jax.Array, part: Part, name: str) -> jax.Array:
        brightness = leaf.astype(jnp.float32)
        x = jnp.concatenate([brightness / 255, jnp.tanh(brightness / 8)], axis=-1)  # or symbols
        layer, features = 0, FEATURES
        while layer == 0 or max(x.shape[1:3]) > SMALL:
            stride = 2 if max(x.shape[1:3]) > SMALL else 1
            convolution = nn.Conv(
                features, (3, 3), stride, name=f"image_{name}_{layer}", dtype=self.dtype
            )
            x, layer, features = nn.gelu(convolution(x)), layer + 1, 2 * FEATURES
        return self._dense(x.reshape(x.shape[0], -1), f"image_{name}")
