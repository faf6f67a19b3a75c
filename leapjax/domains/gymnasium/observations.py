"""The arrays in observations of a Gymnasium environment, and an encoder that reads them.

Each array of an observation is a *part*. It holds choices, or numbers in a vector or a picture. The
encoder turns choices into one-hot codes. It scales numbers by the values in the training data (see
`leapjax.domains.gymnasium.scaling`), because the bounds of spaces are often infinite.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import Dtype

from leapjax.checks import MOST
from leapjax.domain import Statistics
from leapjax.domains.gymnasium.scaling import (
    FEATURES,
    SAMPLE,
    UNMEASURED,
    Knots,
    count_bins,
    find_knots,
    scale_numbers,
)
from leapjax.errors import UserError
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense, embed
from leapjax.types import Context, Demonstration, PyTree

SMALL = 12  # pixels; convolutions halve a picture until no side is longer
FIRST_FEATURES = 32  # features of a picture's first layer; later layers have twice as many
MOST_INPUTS = 2**18  # largest input of a layer; at width 128, training it takes 0.5 GB
MOST_PIXELS = 2**20  # largest number of values in a picture
ROUNDING = 0.1, 1e-3  # allowed rounding error: as a share of the spread, or absolute
NOISE = 1e-12  # relative spread up to which a number is constant but for rounding errors


class Part(NamedTuple):
    """One array of an observation.

    Attributes:
        kind: "vector", "picture" or "choices".
        choices: number of choices of each element; 0 for other kinds.
        first: value of the choice with index 0 in the one-hot code; 0 for other kinds.
    """

    kind: str
    choices: int = 0
    first: int = 0


def blank_of(space: gym.Space, name: str) -> PyTree:
    """Makes an observation of zeros, in types of at most 32 bits, which JAX computes with.

    Raises:
        UserError: no encoder can read the space; says what to do.
    """
    if isinstance(space, gym.spaces.Dict):
        if not space.spaces or not all(isinstance(key, str) for key in space.spaces):
            raise UserError(f"{name} is {space}: expected a Dict with names of its parts")
        return {key: blank_of(space[key], f"{name}[{key!r}]") for key in sorted(space.spaces)}
    if isinstance(space, gym.spaces.Discrete | gym.spaces.MultiDiscrete):
        _check_range_of_choices(space, name)
        return np.zeros(space.shape or (), np.int32)
    if isinstance(space, gym.spaces.Box | gym.spaces.MultiBinary):
        _check_size(space, name)
        return np.zeros(space.shape or (), _narrow_type(np.dtype(space.dtype)))
    raise UserError(
        f"{name} is a {type(space).__name__}: expected Box, Discrete, MultiDiscrete, MultiBinary, "
        "or a Dict of those; a wrapper of Gymnasium can make one of another space, such as "
        "FlattenObservation"
    )


def _narrow_type(dtype: np.dtype) -> np.dtype:
    """Returns the type of at most 32 bits that JAX computes with instead of a NumPy type."""
    if dtype.kind == "f":
        return np.dtype(np.float32)
    return np.dtype(f"{dtype.kind}4") if dtype.itemsize == 8 else dtype


def _check_range_of_choices(space: gym.Space, name: str) -> None:
    (part,) = parts_of(space)
    inputs = part.choices * math.prod(space.shape or ())
    if inputs > MOST_INPUTS:
        raise UserError(
            f"{name} is {str(space)[:60]}, a one-hot code of {inputs} numbers: expected at most "
            f"{MOST_INPUTS}; if its choices are amounts or places, a wrapper of Gymnasium "
            "(TransformObservation) can give them as a Box"
        )
    if not -MOST - 1 <= part.first <= part.first + part.choices - 1 <= MOST:
        raise UserError(f"{name} is {str(space)[:60]}: its choices do not fit int32")


def _check_size(space: gym.Space, name: str) -> None:
    shape = space.shape or ()
    numbers = math.prod(shape)
    if numbers == 0:
        raise UserError(f"{name} is of shape {shape}: it holds no numbers")
    picture = parts_of(space)[0].kind == "picture"
    most = MOST_PIXELS if picture else MOST_INPUTS // count_bins(numbers)
    if numbers > most:
        remedy = "ResizeObservation" if picture else "TransformObservation"
        raise UserError(
            f"{name} is of shape {shape}, {numbers} numbers: expected at most {most}; a wrapper of "
            f"Gymnasium can make it smaller ({remedy})"
        )


def parts_of(space: gym.Space) -> tuple[Part, ...]:
    """Lists the parts of an observation, in the order of `jax.tree.leaves`."""
    if isinstance(space, gym.spaces.Dict):
        return tuple(part for key in sorted(space.spaces) for part in parts_of(space[key]))
    if isinstance(space, gym.spaces.Discrete):
        return (_choices(int(space.start), int(space.start) + int(space.n)),)
    if isinstance(space, gym.spaces.MultiDiscrete):
        starts, counts = space.start.ravel().tolist(), space.nvec.ravel().tolist()
        ends = [start + count for start, count in zip(starts, counts, strict=True)]
        return (_choices(min(starts), max(ends)),)
    axes = len(space.shape or ())
    picture = axes == 3 or (axes == 2 and space.dtype == np.uint8)
    return (Part("picture" if picture else "vector"),)


def _choices(start: int, end: int) -> Part:
    """Makes a part of choices in `start` .. `end - 1`; counts them from 0 if it can."""
    first = min(start, 0) if end <= MOST_INPUTS else start
    return Part("choices", end - first, first)


def check_choices(space: gym.Space, observations: PyTree, where: str) -> None:
    """Checks that choices are in their space; outside it, their one-hot code would be zeros.

    Args:
        space: space of one observation.
        observations: one observation, or several, `[n, ...]`.
        where: where the observations are from, for the message.

    Raises:
        UserError: a choice is outside its space; names it and its range.
    """
    if isinstance(space, gym.spaces.Dict):
        for key, part in space.spaces.items():
            check_choices(part, observations[key], f"{where}: {key}")
        return
    if not isinstance(space, gym.spaces.Discrete | gym.spaces.MultiDiscrete):
        return
    counts = space.n if isinstance(space, gym.spaces.Discrete) else space.nvec
    first = np.asarray(space.start, np.int64)
    last = first + np.asarray(counts, np.int64) - 1
    wrong = (observations < first) | (observations > last)
    if wrong.any():
        at = tuple(np.argwhere(wrong)[0])
        low, high = (np.broadcast_to(each, observations.shape)[at] for each in (first, last))
        raise UserError(f"{where}: a choice of {observations[at]}, expected {low} to {high}")


def check_precision(space: gym.Space, observations: PyTree, where: str) -> None:
    """Checks that float32 can represent how 64-bit numbers change during an episode.

    It cannot if they are seconds since 1970, for example.

    Args:
        space: space of one observation.
        observations: recorded observations `[n + 1, ...]` of an episode.
        where: where the observations are from, for the message.

    Raises:
        UserError: numbers change by too little for float32; says what to do.
    """
    if isinstance(space, gym.spaces.Dict):
        for key, part in space.spaces.items():
            check_precision(part, observations[key], f"{where}: {key}")
        return
    dtype = np.dtype(space.dtype)
    if dtype.kind != "f" or dtype.itemsize <= 4:
        return
    with np.errstate(over="ignore", invalid="ignore"):  # another check rejects overflow
        moved = np.abs(observations - observations.astype(np.float32)).max(axis=0)
        spread, size = observations.std(axis=0), np.abs(observations).max(axis=0)
        lost = (moved > ROUNDING[0] * spread) & (moved > ROUNDING[1]) & (spread > NOISE * size)
        lost &= np.isfinite(moved)
    if lost.any():
        at = np.argwhere(lost)[0].tolist()
        raise UserError(
            f"{where}: the numbers at {at} change by too little for float32, in which networks "
            "compute: subtract an offset from them in the environment, or round them there"
        )


def measure_parts(parts: Sequence[Part], demonstrations: Sequence[Demonstration]) -> Statistics:
    """Finds the knots of each part from all states of the training data.

    Args:
        parts: parts of an observation.
        demonstrations: training data.

    Returns:
        The `Knots` of each part, `()` for choices; `()` alone if all parts are choices, or there
        are no demonstrations.
    """
    if not demonstrations or all(part.kind == "choices" for part in parts):
        return ()
    leaves = zip(*(jax.tree.leaves(each.observations) for each in demonstrations), strict=True)
    return tuple(
        () if part.kind == "choices" else _measure(part, [np.asarray(array) for array in arrays])
        for part, arrays in zip(parts, leaves, strict=True)
    )


def _measure(part: Part, arrays: Sequence[np.ndarray]) -> Knots:
    """Finds the knots of one part from arrays `[n, ...]` of several episodes."""
    shape, states = arrays[0].shape[1:], sum(map(len, arrays))
    columns, bins = _count_columns(part, shape), count_bins(math.prod(shape))
    tables = [_arrange(array, part).reshape(len(array), -1, columns) for array in arrays]
    # A sample of the states is enough for the knots, but the extremes come from all states.
    stride = -(-states * math.prod(shape) // SAMPLE)
    firsts = np.cumsum([0, *map(len, tables)])[:-1]
    some = [table[-first % stride :: stride] for table, first in zip(tables, firsts, strict=True)]
    least = np.min([table.min(axis=(0, 1)) for table in tables], axis=0)
    largest = np.max([table.max(axis=(0, 1)) for table in tables], axis=0)
    sample = np.concatenate(some).reshape(-1, columns)
    return find_knots(np.concatenate([sample, least[None], largest[None]]), bins)


def check_statistics(statistics: Statistics, parts: Sequence[Part], blank: PyTree) -> None:
    """Checks that statistics fit the parts of an observation.

    Raises:
        UserError: they do not fit.
    """
    leaves = jax.tree.leaves(blank)
    fits = len(statistics) == len(parts) and all(
        len(knots) == (0 if part.kind == "choices" else _count_columns(part, leaf.shape))
        and all(
            len(column) > 0 and np.isfinite(column).all() and (np.diff(column) > 0).all()
            for column in knots
        )
        for part, knots, leaf in zip(parts, statistics, leaves, strict=False)
    )
    if not fits:
        raise UserError(
            "what a network knows of its training data is not of this observation space: train it "
            "again"
        )


def _count_columns(part: Part, shape: Sequence[int]) -> int:
    """Counts the columns of numbers in a part; each column has its own knots."""
    if part.kind == "picture":
        return _with_channels(np.zeros((1, *shape), bool)).shape[-1]
    numbers = math.prod(shape)
    return numbers if numbers * count_bins(numbers) <= 2 * FEATURES else 1


def _arrange(states: Any, part: Part) -> Any:
    """Arranges arrays `[n, ...]` as pictures `[n, H, W, C]` or vectors `[n, G]`."""
    if part.kind == "picture":
        return _with_channels(states)
    return states.reshape(len(states), -1)


def _with_channels(pictures: Any) -> Any:
    """Arranges pictures `[n, ...]` as `[n, H, W, C]`.

    Pictures without channels get a single channel. If two neighbouring axes have equal length, the
    third axis holds the channels. Otherwise the shorter of the first and the last axis holds them.
    """
    if pictures.ndim == 3:
        return pictures[..., None]
    one, two, three = pictures.shape[1:]
    first = one != two and (two == three or one < three)
    return pictures.transpose(0, 2, 3, 1) if first else pictures


class StateTokens(Encoder):
    """A token for each state of a context: `[K + 1, D]`, the current state last.

    Attributes:
        parts: parts of an observation.
        width: D, width of a token.
        num_actions: A; 0 if tokens hold neither past actions nor their order.
        dtype: type of matrix products and convolutions.
        statistics: statistics of the training data, from `measure_parts`.
    """

    parts: tuple[Part, ...]
    width: int
    num_actions: int
    dtype: Dtype = jnp.float32
    statistics: Statistics = ()

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens of the K past states and the current state."""
        return self.encode_next(context, None)

    @nn.compact
    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the tokens of all states, given the tokens `[K, D]` of the past states."""
        current = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], context.observation)
        states = current
        if known is None:
            states = jax.tree.map(lambda *both: jnp.concatenate(both), context.past, current)
        leaves = jax.tree.leaves(states)  # each [K + 1, ...], or [1, ...]
        measured = self.statistics or (UNMEASURED,) * len(self.parts)
        read = [
            self._choices(leaf, part, index)
            if part.kind == "choices"
            else self._numbers(leaf, part, knots, index)
            for index, (part, leaf, knots) in enumerate(
                zip(self.parts, leaves, measured, strict=True)
            )
        ]
        tokens = nn.gelu(sum(read, jnp.zeros((len(leaves[0]), self.width))))
        tokens = self._dense(nn.gelu(self._dense(tokens, "mixed")), "token")
        tokens = tokens if known is None else jnp.concatenate([known, tokens])
        if not self.num_actions:
            return tokens
        count = tokens.shape[0]
        done = embed(self.num_actions + 2, self.width, name="action")(context.actions)
        tokens = tokens.at[:-1].add(done)
        return tokens + embed(count, self.width, name="place")(jnp.arange(count))

    def _dense(self, x: jax.Array, name: str) -> jax.Array:
        scale = x.shape[-1] ** -0.5
        return dense(self.width, scale=scale, name=name, dtype=self.dtype)(x)

    def _choices(self, leaf: jax.Array, part: Part, index: int) -> jax.Array:
        places = leaf.astype(jnp.int32) - part.first
        chosen = jax.nn.one_hot(places, part.choices).reshape(leaf.shape[0], -1)
        return self._dense(chosen, f"choices_{index}")

    def _numbers(self, leaf: jax.Array, part: Part, knots: Knots, index: int) -> jax.Array:
        x, layer, features = scale_numbers(_arrange(leaf, part), knots), 0, FIRST_FEATURES
        while part.kind == "picture" and (layer == 0 or max(x.shape[1:3]) > SMALL):
            stride = 2 if max(x.shape[1:3]) > SMALL else 1
            convolution = nn.Conv(
                features, (3, 3), stride, name=f"picture_{index}_{layer}", dtype=self.dtype
            )
            x, layer, features = nn.gelu(convolution(x)), layer + 1, 2 * FIRST_FEATURES
        return self._dense(x.reshape(x.shape[0], -1), f"{part.kind}_{index}")
