"""Lookalikes: clutter that may share the kind or the colour of the target."""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.augmentation.clutter import (
    choose_cells,
    draw_unlike,
    find_target,
    put_objects,
)
from leapjax.domains.babyai.augmentation.words import GridWords
from leapjax.types import Window


def add_lookalikes(key: jax.Array, window: Window, share: float, words: GridWords) -> Window:
    """Adds objects like BabyAI's `add_clutter`; some of them resemble the target.

    If the instruction names both kind and colour of the target, a new object may share either, but
    not both.

    Args:
        key: random key.
        window: one training example.
        share: largest probability of a free cell to get an object, in 0 .. 1.
        words: the words that name kinds and colours.
    """
    share_key, where_key, kind_key, colour_key = jax.random.split(key, 4)
    target, cells = find_target(window.context), window.context.observation.grid.shape[:2]
    both = names_both(window.context.observation.instruction, target, words)
    kind, colour = draw_other(kind_key, colour_key, target, cells, both)
    return put_objects(window, choose_cells(share_key, where_key, window, share), kind, colour)


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
