"""Numbers of any size as inputs of a network: scaled by the values that training data have.

Each column of numbers has *knots*, values of the training data in ascending order. A number becomes
one feature for each interval between two knots: -1 below the interval, 1 above, linear inside
(Gorishniy et al., 2022, "On Embeddings for Numerical Features in Tabular Deep Learning"). Mean and
standard deviation would serve as well until one value of 1e9 stands for "nothing seen": then all
others would be one number.
"""

import jax
import jax.numpy as jnp
import numpy as np

Knots = tuple[tuple[float, ...], ...]  # of each column; of one column: all numbers share them

BINS = 16  # intervals of a column, at most
FEWEST_BINS = 4  # of a column of a large array
FEATURES = 2**13  # of an array: one with more numbers has fewer intervals
SAMPLE = 2**22  # numbers that knots are found in; the least and the largest are of all
# Without training data nothing is known of the size of numbers, and nothing is learned.
UNMEASURED: Knots = ((-10.0, -1.0, -0.1, -0.01, 0.0, 0.01, 0.1, 1.0, 10.0),)
LARGEST = float(np.finfo(np.float32).max)


def count_bins(numbers: int) -> int:
    """The most intervals that each number of an array of so many has."""
    return min(BINS, max(FEWEST_BINS, FEATURES // numbers))


def find_knots(values: np.ndarray, bins: int) -> Knots:
    """Finds the knots of each column.

    All distinct values, if there are few. If not, half of the knots are quantiles of the values,
    which tell frequent values apart, and half are quantiles of the distinct values, which tell
    rare ones apart.

    Args:
        values: `[n, G]`, n > 0.
        bins: how many intervals there may be, an even number.
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
    """Turns numbers `[..., G]` into features `[..., G m]`, m the most intervals of a column.

    Beyond the outermost knots features grow with the logarithm of the distance. A column with one
    knot never changed in the training data, so nothing is known of its changes: it gives zeros.

    Args:
        values: of any real type.
        knots: of each of the G columns, or of one that all share.
    """
    longest = max(2, *(len(column) for column in knots))
    table = np.array([column + column[-1:] * (longest - len(column)) for column in knots])
    starts, widths = table[:, :-1], np.minimum(np.diff(table), LARGEST)
    first = np.arange(longest - 1) == 0
    last = np.arange(longest - 1) == np.array([[len(column) - 2] for column in knots])
    wide = widths > 0
    # The reciprocal of 3e38 is not a number that devices have, nor is that of 1e-39.
    factors = np.where(widths > 1, 2.0**-64, 2.0**64)
    distances = _subtract(values[..., None], starts) * jnp.float32(factors)
    places = distances / jnp.float32(np.where(wide, widths * factors, 1.0))
    places = jnp.clip(places, -LARGEST, LARGEST)
    below = -jnp.log1p(jnp.maximum(-places, 0)) * first
    above = jnp.log1p(jnp.maximum(places - 1, 0)) * last
    features = jnp.where(wide, 2 * (jnp.clip(places, 0, 1) + below + above) - 1, 0)
    return features.reshape(*values.shape[:-1], -1)


def _subtract(values: jax.Array, knots: np.ndarray) -> jax.Array:
    """Differences in float32, exact wherever float32 has them."""
    if values.dtype.itemsize == 4 and jnp.issubdtype(values.dtype, jnp.integer):
        # float32 has no 2,000,000,001: the upper and the lower 16 bits are subtracted apart.
        upper, lower = (values >> 16).astype(jnp.float32), (values & 0xFFFF).astype(jnp.float32)
        high = np.floor(knots / 2**16)
        low = knots - high * 2**16
        return (upper - jnp.float32(high)) * 2**16 + (lower - jnp.float32(low))
    return jnp.clip(values.astype(jnp.float32) - jnp.float32(knots), -LARGEST, LARGEST)
