"""Clutter: random objects on cells that a demonstration does not need."""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import symmetries
from leapjax.types import Context, Window


def add_clutter(key: jax.Array, window: Window, share: float) -> Window:
    """Puts random objects on cells that the demonstration does not need.

    A shortest path stays the shortest when objects block other paths. So the demonstration stays
    optimal, and shows that paths lead around objects. (If a demonstration holds random actions, up
    to one window in 120 handles a new object.)

    Half of the windows do not change. In the others each free cell gets an object with a
    probability that is drawn for the window, in 0 .. `share`. Kind and colour both differ from
    the target's, so no instruction means the new object. Windows without a goal do not change,
    because the meaning of their instruction is unknown here.

    Args:
        key: random key.
        window: training window.
        share: largest probability, in 0 .. 1.
    """
    share_key, where_key, kind_key, colour_key = jax.random.split(key, 4)
    target, cells = find_target(window.context), window.context.observation.grid.shape[:2]
    kind, colour = draw_unlike(kind_key, colour_key, target, cells)
    return put_objects(window, choose_cells(share_key, where_key, window, share), kind, colour)


def choose_cells(
    share_key: jax.Array, where_key: jax.Array, window: Window, share: float
) -> jax.Array:
    """Draws cells `[S, S]` that are free in all states and that the demonstration does not need."""
    observation, past = window.context.observation, window.context.past.grid
    # The past is all zeros before the start.
    free = (observation.grid[..., 0] == symmetries.EMPTY) & (past[..., 0] <= symmetries.EMPTY).all(
        axis=0
    )
    probability = share * jax.random.uniform(share_key, minval=-1.0)  # no cell if negative
    chosen = jax.random.uniform(where_key, free.shape) < probability
    return chosen & free & ~window.extras & (observation.goal[0] >= 0)


def draw_unlike(
    kind_key: jax.Array, colour_key: jax.Array, target: jax.Array, cells: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Draws kinds and colours `[S, S]` that differ from a target `[3]` in both."""
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    # A cyclic shift by at least one never gives the target's kind or colour.
    shift = jax.random.randint(kind_key, cells, 1, len(kinds))
    kind = kinds[(target[0] - kinds[0] + shift) % len(kinds)]
    shift = jax.random.randint(colour_key, cells, 1, symmetries.COLOURS)
    return kind, (target[1] + shift) % symmetries.COLOURS


def put_objects(window: Window, chosen: jax.Array, kind: jax.Array, colour: jax.Array) -> Window:
    """Puts objects on the chosen cells of every state; all three arrays are `[S, S]`."""
    context = window.context
    grid = context.observation.grid
    objects = jnp.stack([kind, colour, jnp.zeros_like(kind)], axis=-1).astype(grid.dtype)

    def fill(image: jax.Array) -> jax.Array:
        known = image[..., 0] == symmetries.EMPTY
        return jnp.where((chosen & known)[..., None], objects, image)

    observation = context.observation._replace(grid=fill(grid))
    before = context.past._replace(grid=jax.vmap(fill)(context.past.grid))
    return window._replace(context=context._replace(observation=observation, past=before))


def find_target(context: Context) -> jax.Array:
    """Returns the object on the goal's cell, or the last object there: `[3]` int32."""
    x, y = context.observation.goal
    now = jnp.asarray(context.observation.grid)[x, y]
    seen = jnp.concatenate([jnp.asarray(context.past.grid)[:, x, y], now[None]])  # [K + 1, 3]
    thing = symmetries.is_coloured(seen[:, 0])
    last = jnp.argmax(thing * jnp.arange(1, len(seen) + 1))
    return seen[last].astype(jnp.int32)
