"""Random objects that an instruction does not mean."""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.augmentation.words import GridWords


def draw_unlike(
    kind_key: jax.Array, colour_key: jax.Array, target: jax.Array, cells: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Draws kinds and colours `[S, S]` that both differ from those of the target `[3]`."""
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    # A cyclic shift by at least one never gives the target's.
    shift = jax.random.randint(kind_key, cells, 1, len(kinds))
    kind = kinds[(target[0] - kinds[0] + shift) % len(kinds)]
    shift = jax.random.randint(colour_key, cells, 1, symmetries.COLOURS)
    return kind, (target[1] + shift) % symmetries.COLOURS


def draw_other(
    kind_key: jax.Array,
    colour_key: jax.Array,
    target: jax.Array,
    cells: tuple[int, ...],
    both: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Draws like `draw_unlike`; if `both` holds, the kind or the colour may be the target's."""
    kinds, count = jnp.array(symmetries.INTERCHANGEABLE), len(symmetries.INTERCHANGEABLE)
    # All pairs but the target's have the same probability.
    pair = (target[0] - kinds[0]) * symmetries.COLOURS + target[1]
    every = count * symmetries.COLOURS
    other = (pair + jax.random.randint(kind_key, cells, 1, every)) % every
    kind, colour = draw_unlike(kind_key, colour_key, target, cells)
    return (
        jnp.where(both, kinds[other // symmetries.COLOURS], kind),
        jnp.where(both, other % symmetries.COLOURS, colour),
    )


def names_both(instruction: jax.Array, target: jax.Array, words: GridWords) -> jax.Array:
    """Returns whether an instruction `[L]` names both kind and colour of the target `[3]`."""
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    kind = jnp.asarray(words.objects)[jnp.argmax(kinds == target[0])]
    colour = jnp.asarray(words.colours)[target[1]]
    known = (kinds == target[0]).any()
    return known & (instruction == kind).any() & (instruction == colour).any()
