"""Detours: windows whose path leads around obstacles."""

import jax
import jax.numpy as jnp

from experiments.augmentation.earlier_moves import prepend_moves
from experiments.augmentation.lookalikes import draw_other, names_both
from leapjax.domains.babyai.augmentation.words import GridWords
from leapjax.domains.babyai.dynamics import FORWARD, find_passable
from leapjax.domains.babyai.symmetries import EMPTY, LEFT, RIGHT
from leapjax.types import Window

DETOUR_MOVES = 8  # before the window, at most
TRIES = 8  # to find a detour
WALL, GREY = 2, 5  # MiniGrid's indices


def add_detour(key: jax.Array, window: Window, share: float, words: GridWords) -> Window:
    """Makes a window take a longer path, in a world where that path is the shortest.

    Each try prepends up to eight random moves, puts objects and walls beside the path, many or
    few, and succeeds if no shorter path is left. So windows show that paths lead around
    obstacles, even if the demonstrations come from empty rooms. A try whose path is longer than
    without the obstacles is preferred.

    Windows do not change if every try fails, or if there are past states.

    Args:
        key: random key.
        window: one training example.
        share: probability of trying.
        words: the words that name kinds and colours.
    """
    if window.context.actions.shape[0]:
        return window
    take_key, tries_key = jax.random.split(key)
    keys = jax.random.split(tries_key, TRIES)
    found, possible, longer = jax.vmap(lambda k: _try_detour(k, window, words))(keys)
    best = jnp.argmax(possible * (1 + longer))
    taken = possible[best] & jax.random.bernoulli(take_key, share)
    return jax.tree.map(lambda a, b: jnp.where(taken, a[best], b), found, window)


def _try_detour(
    key: jax.Array, window: Window, words: GridWords
) -> tuple[Window, jax.Array, jax.Array]:
    """Makes a longer window; returns also whether it succeeds, and whether obstacles matter."""
    count_key, start_key, share_key, where_key, kind_key, colour_key, wall_key = jax.random.split(
        key, 7
    )
    count = jax.random.randint(count_key, (), 0, DETOUR_MOVES + 1)
    earlier, whole, possible = prepend_moves(start_key, window, count, DETOUR_MOVES, 2 / 3)
    observation, path = earlier.context.observation, earlier.extras
    grid, goal = observation.grid, observation.goal
    cells = grid.shape[:2]
    probability = jax.random.uniform(share_key) ** 0.5  # many objects are likelier than few
    filled = (grid[..., 0] == EMPTY) & ~path
    filled &= jax.random.uniform(where_key, cells) < probability
    # Obstacles are grey walls, and objects that the instruction does not mean.
    target = grid[goal[0], goal[1]].astype(jnp.int32)
    both = names_both(observation.instruction, target, words)
    kinds, colours = draw_other(kind_key, colour_key, target, cells, both)
    walls = jax.random.bernoulli(wall_key, shape=cells)
    kinds, colours = jnp.where(walls, WALL, kinds), jnp.where(walls, GREY, colours)
    things = jnp.stack([kinds, colours, jnp.zeros_like(kinds)], axis=-1).astype(grid.dtype)
    filled_grid = jnp.where(filled[..., None], things, grid)

    def moves(grid: jax.Array) -> jax.Array:
        free = find_passable(grid).at[goal[0], goal[1]].set(True)
        return count_moves(free, observation.pose[:2], goal)

    # A path that visits no cell twice has as many cells, without the goal, as moves to the goal.
    length = path.sum()
    first = (whole == FORWARD) & (jnp.arange(len(whole)) < count)
    possible &= length == window.extras.sum() + first.sum()
    possible &= (moves(filled_grid) == length) & (goal[0] >= 0) & ~_wastes_turns(whole)
    context = earlier.context._replace(observation=observation._replace(grid=filled_grid))
    return earlier._replace(context=context), possible, moves(grid) < length


def count_moves(free: jax.Array, start: jax.Array, goal: jax.Array) -> jax.Array:
    """Counts moves from a cell `[2]` to another through free cells `[S, S]`; inf without a path."""
    cells = free.shape

    def spread(_: jax.Array, found: jax.Array) -> jax.Array:
        around = jnp.pad(found, 1, constant_values=jnp.inf)
        near = jnp.stack([around[2:, 1:-1], around[:-2, 1:-1], around[1:-1, 2:], around[1:-1, :-2]])
        return jnp.where(free, jnp.minimum(found, near.min(axis=0) + 1), jnp.inf)

    begun = jnp.full(cells, jnp.inf).at[start[0], start[1]].set(0.0)
    found = jax.lax.fori_loop(0, 4 * cells[0], spread, begun)
    return found[goal[0], goal[1]]


def _wastes_turns(actions: jax.Array) -> jax.Array:
    """Returns whether turns of a plan `[T]` undo each other, or three in a row replace one."""
    turning = jnp.where(actions == LEFT, -1, jnp.where(actions == RIGHT, 1, 0))
    undone = (turning[1:] * turning[:-1] == -1).any()
    return undone | (jnp.abs(turning[2:] + turning[1:-1] + turning[:-2]) == 3).any()
