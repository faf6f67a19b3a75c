"""More windows from the same demonstrations: symmetries of the world, and clutter in it.

The extras of a window are its way: `[S, S]` bool, the cells that the demonstration needs free
from here on.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.babyai import symmetries, vocabulary
from leapjax.babyai.observations import Observation
from leapjax.babyai.settings import Settings
from leapjax.domain import Augmentation
from leapjax.types import Array, Demonstration, Window


class GridWords(NamedTuple):
    """Which token ids name what, for the symmetries of a world with instructions."""

    colours: Array  # [6] int32, in MiniGrid's order of colours
    objects: Array  # [3] int32: key, ball, box
    mirrored: Array  # [vocabulary] int32: the word that each word becomes in a mirror
    then: Array  # [2] int32: ", then"
    after: Array  # [2] int32: "after you"


def grid_words() -> GridWords:
    """The words of BabyAI's vocabulary that name what."""
    return GridWords(
        vocabulary.colour_words(),
        vocabulary.object_words(symmetries.INTERCHANGEABLE),
        vocabulary.mirrored_words(),
        *vocabulary.joining_words(),
    )


def chosen(settings: Settings) -> list[Augmentation]:
    """The augmentations that are asked for, the one that comes last first."""
    found: list[Augmentation] = []
    if settings.augment:
        found.append(lambda key, w: augment(key, w, grid_words(), settings.exchange_objects))
    if settings.clutter:
        found.append(lambda key, w: clutter(key, w, settings.clutter))
    return found


def way(demonstration: Demonstration) -> np.ndarray:
    """`[n, S, S]` bool: where the agent stands, or puts something down, from each step on."""
    poses, actions = demonstration.observations.pose, demonstration.actions
    needed = np.zeros((len(poses), *demonstration.observations.grid.shape[1:3]), bool)
    needed[np.arange(len(poses)), poses[:, 0], poses[:, 1]] = True
    drops = np.flatnonzero(actions == symmetries.DROP)
    front = poses[drops, :2] + symmetries.DIRECTION_VECTORS[poses[drops, 2]]
    front = front.clip(0, needed.shape[1] - 1)  # a user's data may face out of the grid
    needed[drops, front[:, 0], front[:, 1]] = True
    return np.logical_or.accumulate(needed[::-1])[::-1][:-1]


def clutter(key: jax.Array, window: Window, share: float) -> Window:
    """A window with objects where the demonstration never goes.

    The shortest way stays the shortest when others are blocked, so the demonstration stays as
    good as it was; what changes is what it shows: that ways lead around things.

    Half of the windows stay as they are; in the others each free cell gets an object with a
    probability that is drawn for the window, in 0 .. `share`. Kind and colour both differ from
    the target's, so that no instruction means the new object. Windows without a goal stay as
    they are, because what their instruction means is not known here.

    Args:
        key: chooses.
        window: one training example.
        share: of the cells that nobody needs, in 0 .. 1.
    """
    share_key, where_key, kind_key, colour_key = jax.random.split(key, 4)
    context = window.context
    grid, past, goal = context.observation.grid, context.past.grid, context.observation.goal
    cells = grid.shape[:2]
    # Free now and in all of the past, of which cells before the start are all zero.
    free = (grid[..., 0] == symmetries.EMPTY) & (past[..., 0] <= symmetries.EMPTY).all(axis=0)
    probability = share * jax.random.uniform(share_key, minval=-1.0)  # negative: none
    filled = jax.random.uniform(where_key, cells) < probability
    filled &= free & ~window.extras & (goal[0] >= 0)
    target = grid[goal[0], goal[1]].astype(jnp.int32)
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    # Not the target's: a shift by at least one, around a circle.
    shift = jax.random.randint(kind_key, cells, 1, len(kinds))
    kind = kinds[(target[0] - kinds[0] + shift) % len(kinds)]
    shift = jax.random.randint(colour_key, cells, 1, symmetries.COLOURS)
    colour = (target[1] + shift) % symmetries.COLOURS
    objects = jnp.stack([kind, colour, jnp.zeros_like(kind)], axis=-1).astype(grid.dtype)

    def fill(image: jax.Array) -> jax.Array:
        known = image[..., 0] == symmetries.EMPTY
        return jnp.where((filled & known)[..., None], objects, image)

    observation = context.observation._replace(grid=fill(grid))
    before = context.past._replace(grid=jax.vmap(fill)(past))
    return window._replace(context=context._replace(observation=observation, past=before))


def augment(key: jax.Array, window: Window, words: GridWords, exchange_objects: bool) -> Window:
    """A window as it could have been: mirrored, recoloured, with other objects, in other words.

    Each is a symmetry of the levels, so the result is just as good a demonstration.

    Args:
        key: chooses.
        window: one training example.
        words: which word names what.
        exchange_objects: whether key, ball and box are alike, which they are in
            demonstrations that unlock no door and toggle no box.
    """
    # Here and not before: a program says how many devices it has after a domain is made.
    words = jax.tree.map(jnp.asarray, words)
    flip_key, colour_key, object_key, restate_key = jax.random.split(key, 4)
    colours = jax.random.permutation(colour_key, len(words.colours))
    objects = jnp.arange(symmetries.AGENT + 1)
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    vocabulary = jnp.arange(words.mirrored.shape[0])
    vocabulary = vocabulary.at[words.colours].set(words.colours[colours])
    if exchange_objects:
        order = jax.random.permutation(object_key, len(kinds))
        objects = objects.at[kinds].set(kinds[order])
        vocabulary = vocabulary.at[words.objects].set(words.objects[order])
    renaming = symmetries.Renaming(colours, objects, vocabulary)
    renamed = _throughout(window, lambda observation: symmetries.rename(observation, renaming))
    restated = _either(restate_key, restate(renamed, words), renamed)
    return _either(flip_key, reflect(restated, words.mirrored), restated)


def _throughout(window: Window, change: Callable[[Observation], Observation]) -> Window:
    """A window with every state changed, the past ones too."""
    context = window.context
    return window._replace(
        context=context._replace(
            observation=change(context.observation), past=jax.vmap(change)(context.past)
        )
    )


def _either(key: jax.Array, first: Window, second: Window) -> Window:
    """One of two windows, with equal chances."""
    take = jax.random.bernoulli(key)
    return jax.tree.map(lambda a, b: jnp.where(take, a, b), first, second)


def restate(window: Window, words: GridWords) -> Window:
    """The same window, told with the other of ", then" and "after you"."""

    def say(observation: Observation) -> Observation:
        said = symmetries.restate(observation.instruction, words.then, words.after)
        return observation._replace(instruction=said)

    return _throughout(window, say)


def reflect(window: Window, mirrored_words: jax.Array) -> Window:
    """The mirror image of one window."""
    context = window.context
    past = jax.vmap(lambda o: symmetries.reflect(o, mirrored_words))(context.past)
    # Blank states before the start have no mirror image.
    length = context.actions.shape[0]
    known = jnp.arange(length, 0, -1) <= context.step

    def keep_blank(mirrored: jax.Array, original: jax.Array) -> jax.Array:
        return jnp.where(known.reshape(length, *(1,) * (mirrored.ndim - 1)), mirrored, original)

    return window._replace(
        context=context._replace(
            observation=symmetries.reflect(context.observation, mirrored_words),
            past=jax.tree.map(keep_blank, past, context.past),
            actions=symmetries.reflect_actions(context.actions),
        ),
        actions=symmetries.reflect_actions(window.actions),
        extras=window.extras[:, ::-1],
    )
