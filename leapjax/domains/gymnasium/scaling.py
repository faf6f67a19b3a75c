"""Scales numbers of any size to inputs of a network, by the values in the training data.

Each column of numbers has *knots*, values of the training data in ascending order. A number becomes
one feature for each interval between two knots. The feature is -1 below the interval, 1 above it,
and linear inside. Source: Gorishniy et al., 2022, "On Embeddings for Numerical Features in Tabular
Deep Learning".

Mean and standard deviation would fail where, for example, 1e9 marks a missing value: all other
values would become nearly equal.
"""

import jax
import jax.numpy as jnp
import numpy as np

Knots = tuple[tuple[float, ...], ...]  # knots of each column, or of one column for all numbers

BINS = 16  # most intervals of a column
FEWEST_BINS = 4  # intervals of a column in a large array
FEATURES = 2**13  # features of an array; with more numbers, each has fewer intervals
SAMPLE = 2**22  # numbers to find knots in; the smallest and the largest come from all numbers
# Knots of a network without training data, which does not learn either.
UNMEASURED: Knots = ((-10.0, -1.0, -0.1, -0.01, 0.0, 0.01, 0.1, 1.0, 10.0),)
LARGEST = float(np.finfo(np.float32).max)


def count_bins(numbers: int) -> int:
    """Returns the most intervals of each number in an array of so many `numbers`."""
    return min(BINS, max(FEWEST_BINS, FEATURES // numbers))


def find_knots(values: np.ndarray, bins: int) -> Knots:
    """Finds the knots of each column.

    If a column has few distinct values, all of them are knots. Otherwise half of the knots are
    quantiles of the values, to separate frequent values. The other half are quantiles of the
    distinct values, to separate rare values.

    Args:
        values: numbers `[n, G]`, n > 0.
        bins: largest number of intervals, an even number.
    """
    return tuple(_column_knots(np.sort(column), bins) for column in values.T)


def _column_knots(ordered: np.ndarray, bins: int) -> tuple[float, ...]:
    distinct = np.unique(ordered)
    if len(distinct) > bins + 1:
        half = bins // 2
        frequent = ordered[np.linspace(0, len(ordered) - 1, half + 1).astype(int)]
        rare = distinct[np.linspace(0, len(distinct) - 1, half + 2).astype(int)]
        distinct = np.union1d(frequent, rare)  # both hold the ends: at most `bins + 1`
    return tuple(float(value) for value in distinct)


def scale_numbers(values: jax.Array, knots: Knots) -> jax.Array:
    """Turns numbers `[..., G]` into features `[..., G m]`, with m intervals for each column.

    Columns with fewer intervals get zeros for the others. Beyond the outermost knots, features grow
    with the logarithm of the distance. A column with one knot was constant in the training data:
    its features are zeros.

    Args:
        values: numbers of any real type.
        knots: knots of each of the G columns, or of one column for all numbers.
    """
    longest = max(2, *(len(column) for column in knots))
    table = np.array([column + column[-1:] * (longest - len(column)) for column in knots])
    starts, widths = table[:, :-1], np.minimum(np.diff(table), LARGEST)
    first = np.arange(longest - 1) == 0
    last = np.arange(longest - 1) == np.array([[len(column) - 2] for column in knots])
    wide = widths > 0
    # Devices cannot represent the reciprocals of 3e38 and of 1e-39: multiply by factors first.
    factors = np.where(widths > 1, 2.0**-64, 2.0**64)
    distances = _subtract(values[..., None], starts) * jnp.float32(factors)
    places = distances / jnp.float32(np.where(wide, widths * factors, 1.0))
    places = jnp.clip(places, -LARGEST, LARGEST)
    below = -jnp.log1p(jnp.maximum(-places, 0)) * first
    above = jnp.log1p(jnp.maximum(places - 1, 0)) * last
    features = jnp.where(wide, 2 * (jnp.clip(places, 0, 1) + below + above) - 1, 0)
    return features.reshape(*values.shape[:-1], -1)


def _subtract(values: jax.Array, knots: np.ndarray) -> jax.Array:
    """Subtracts knots from values in float32; exact if float32 can represent the difference."""
    if values.dtype.itemsize == 4 and jnp.issubdtype(values.dtype, jnp.integer):
        # float32 cannot represent 2,000,000,001: subtract the upper and the lower 16 bits apart.
        upper, lower = (values >> 16).astype(jnp.float32), (values & 0xFFFF).astype(jnp.float32)
        high = np.floor(knots / 2**16)
        low = knots - high * 2**16
        return (upper - jnp.float32(high)) * 2**16 + (lower - jnp.float32(low))
    return jnp.clip(values.astype(jnp.float32) - jnp.float32(knots), -LARGEST, LARGEST)
