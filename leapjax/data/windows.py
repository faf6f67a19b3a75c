"""Windows of demonstrations: what one training example is, and how a batch is drawn.

A window starts at one step of one demonstration. It holds the K steps before it, the
state there, and the T actions from there on; past the end of the demonstration the action
is `end`, predicted like any other. States after the start never enter (paper, eq. 4).
"""

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.data import symmetries
from leapjax.data.demonstrations import Demonstration
from leapjax.types import Array, Context, Observation, pad_token


class Steps(NamedTuple):
    """All steps of all demonstrations, one after the other: M steps of E episodes."""

    observations: Observation  # [M, ...] the state before each action
    actions: Array  # [M] int32
    step: Array  # [M] int32: steps since the episode began
    remaining: Array  # [M] int32: actions of the episode from here on, this one included
    starts: Array  # [E] int32: the index of each episode's first step
    lengths: Array  # [E] int32: its number of actions


class GridWords(NamedTuple):
    """Which token ids name what, for the symmetries of a world with instructions."""

    colours: Array  # [6] int32, in MiniGrid's order of colours
    objects: Array  # [3] int32: key, ball, box
    mirrored: Array  # [vocabulary] int32: the word that each word becomes in a mirror


class Window(NamedTuple):
    """One training example."""

    context: Context
    actions: Array  # [T] int32: what to predict


def fingerprint(steps: Steps) -> str:
    """A name for exactly this data: sixteen hexadecimal digits."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(steps):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:16]


def concatenate(demonstrations: Sequence[Demonstration]) -> Steps:
    """Lays demonstrations out for `window`."""
    lengths = np.array([len(d.actions) for d in demonstrations], np.int32)
    step = np.concatenate([np.arange(n, dtype=np.int32) for n in lengths])
    fields = zip(*(d.observations for d in demonstrations), strict=True)
    return Steps(
        Observation(*(np.concatenate([part[:-1] for part in parts]) for parts in fields)),
        np.concatenate([d.actions for d in demonstrations]),
        step,
        np.repeat(lengths, lengths) - step,
        np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int32),
        lengths,
    )


def window(steps: Steps, index: jax.Array, context: int, horizon: int, end: int) -> Window:
    """The window that starts at step `index []`.

    Args:
        steps: the data.
        index: of the current step, in 0 .. M - 1.
        context: K.
        horizon: T.
        end: the end action, `A - 1`.
    """
    ahead = jnp.arange(horizon)
    last = steps.actions.shape[0] - 1
    actions = steps.actions[jnp.minimum(index + ahead, last)]
    actions = jnp.where(ahead < steps.remaining[index], actions, end)
    back = jnp.arange(-context, 0)
    known = -back <= steps.step[index]
    earlier = jnp.where(known, index + back, 0)

    def take_past(leaf: jax.Array) -> jax.Array:
        shape = (context,) + (1,) * (leaf.ndim - 1)
        return jnp.where(known.reshape(shape), leaf[earlier], 0)

    return Window(
        Context(
            jax.tree.map(lambda leaf: leaf[index], steps.observations),
            jax.tree.map(take_past, steps.observations),
            jnp.where(known, steps.actions[earlier], pad_token(end + 1)),
            steps.step[index],
        ),
        actions,
    )


def sample_windows(
    key: jax.Array, steps: Steps, batch: int, context: int, horizon: int, end: int, by: str
) -> Window:
    """A batch `[B, ...]` of windows: a function of `key` and the data alone.

    `by` is "episode" (a uniform demonstration, then a uniform step of it, as in the
    authors' code) or "step" (a uniform step, so that long demonstrations count for more).

    Raises:
        ValueError: another `by`.
    """
    if by == "step":
        index = jax.random.randint(key, (batch,), 0, steps.actions.shape[0])
    elif by == "episode":
        episode_key, step_key = jax.random.split(key)
        episode = jax.random.randint(episode_key, (batch,), 0, steps.starts.shape[0])
        offset = jax.random.uniform(step_key, (batch,)) * steps.lengths[episode]
        index = steps.starts[episode] + offset.astype(jnp.int32)
    else:
        raise ValueError(f"unknown sampling {by!r}: expected episode or step")
    return jax.vmap(lambda i: window(steps, i, context, horizon, end))(index)


def augment(key: jax.Array, window: Window, words: GridWords, exchange_objects: bool) -> Window:
    """A window as it could have been: mirrored, recoloured, with other objects.

    Each is a symmetry of the levels, so the result is just as good a demonstration.

    Args:
        key: chooses.
        window: one training example.
        words: which word names what.
        exchange_objects: whether key, ball and box are alike, which they are in
            demonstrations that unlock no door and toggle no box.
    """
    flip_key, colour_key, object_key = jax.random.split(key, 3)
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
    context = window.context
    renamed = window._replace(
        context=context._replace(
            observation=symmetries.rename(context.observation, renaming),
            past=jax.vmap(lambda o: symmetries.rename(o, renaming))(context.past),
        )
    )
    flip = jax.random.bernoulli(flip_key)
    mirrored = reflect(renamed, words.mirrored)
    return jax.tree.map(lambda a, b: jnp.where(flip, a, b), mirrored, renamed)


def reflect(window: Window, mirrored_words: jax.Array) -> Window:
    """The mirror image of one window."""
    context = window.context
    past = jax.vmap(lambda o: symmetries.reflect(o, mirrored_words))(context.past)
    # Blank states before the start have no mirror image.
    length = context.actions.shape[0]
    known = jnp.arange(length, 0, -1) <= context.step

    def keep_blank(mirrored: jax.Array, original: jax.Array) -> jax.Array:
        return jnp.where(known.reshape(length, *(1,) * (mirrored.ndim - 1)), mirrored, original)

    return Window(
        context._replace(
            observation=symmetries.reflect(context.observation, mirrored_words),
            past=jax.tree.map(keep_blank, past, context.past),
            actions=symmetries.reflect_actions(context.actions),
        ),
        symmetries.reflect_actions(window.actions),
    )
