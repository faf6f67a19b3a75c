"""Clutter: random objects on cells that a demonstration does not need."""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.augmentation.objects import draw_other, draw_unlike, names_both
from leapjax.domains.babyai.augmentation.words import GridWords
from leapjax.domains.babyai.dynamics import DOOR
from leapjax.types import Context, Window


def add_clutter(
    key: jax.Array, window: Window, share: float, lookalikes: GridWords | None = None
) -> Window:
    """Puts random objects on cells that the demonstration does not need.

    A shortest path stays the shortest when other paths are blocked, so the demonstration stays
    optimal, and shows that paths lead around objects. (If random actions replace those of the
    demonstration, up to one window in 120 handles a new object.)

    Half of the windows do not change. In the others each free cell gets an object with a
    probability that is drawn for the window, in 0 .. `share`. Kind and colour both differ from
    the target's, so no instruction means the new object. With `lookalikes` one of them may be
    the target's if the instruction names both. Windows without a goal do not change, because the
    meaning of their instruction is unknown here.

    Args:
        key: of the random choices.
        window: one training example.
        share: largest probability, in 0 .. 1.
        lookalikes: the words that name kinds and colours; None for no lookalikes.
    """
    share_key, where_key, kind_key, colour_key = jax.random.split(key, 4)
    context = window.context
    grid, past, goal = context.observation.grid, context.past.grid, context.observation.goal
    cells = grid.shape[:2]
    # Free now and in all of the past, which is all zeros before the start.
    free = (grid[..., 0] == symmetries.EMPTY) & (past[..., 0] <= symmetries.EMPTY).all(axis=0)
    probability = share * jax.random.uniform(share_key, minval=-1.0)  # negative: none
    filled = jax.random.uniform(where_key, cells) < probability
    filled &= free & ~window.extras & (goal[0] >= 0)
    target = _find_target(context)
    if lookalikes is None:
        kind, colour = draw_unlike(kind_key, colour_key, target, cells)
    else:
        both = names_both(context.observation.instruction, target, lookalikes)
        kind, colour = draw_other(kind_key, colour_key, target, cells, both)
    objects = jnp.stack([kind, colour, jnp.zeros_like(kind)], axis=-1).astype(grid.dtype)

    def fill(image: jax.Array) -> jax.Array:
        known = image[..., 0] == symmetries.EMPTY
        return jnp.where((filled & known)[..., None], objects, image)

    observation = context.observation._replace(grid=fill(grid))
    before = context.past._replace(grid=jax.vmap(fill)(past))
    return window._replace(context=context._replace(observation=observation, past=before))


def _find_target(context: Context) -> jax.Array:
    """Returns the object on the goal's cell, or the last one there: `[3]` int32."""
    x, y = context.observation.goal
    now = jnp.asarray(context.observation.grid)[x, y]
    seen = jnp.concatenate([jnp.asarray(context.past.grid)[:, x, y], now[None]])  # [K + 1, 3]
    thing = (seen[:, 0] >= DOOR) & (seen[:, 0] <= symmetries.INTERCHANGEABLE[-1])
    last = jnp.argmax(thing * jnp.arange(1, len(seen) + 1))
    return seen[last].astype(jnp.int32)
