"""Windows of demonstrations: what one training example is, and how a batch is drawn.

A window starts at one step of one demonstration. It holds the K steps before it, the
state there, and the T actions from there on; past the end of the demonstration the action
is `end`, predicted like any other. States after the start never enter (paper, eq. 4); the
cells that they need free are kept for augmentation, and no model sees them.
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
    way: Array  # [M, S, S] bool: cells that the episode needs free from here on


class Window(NamedTuple):
    """One training example."""

    context: Context
    actions: Array  # [T] int32: what to predict
    way: Array  # [S, S] bool: cells that the rest of the demonstration needs free


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
        np.concatenate([_way(d) for d in demonstrations]),
    )


def _way(demonstration: Demonstration) -> np.ndarray:
    """`[n, S, S]` bool: where the agent stands, or puts something down, from each step on."""
    poses, actions = demonstration.observations.pose, demonstration.actions
    needed = np.zeros((len(poses), *demonstration.observations.grid.shape[1:3]), bool)
    needed[np.arange(len(poses)), poses[:, 0], poses[:, 1]] = True
    drops = np.flatnonzero(actions == symmetries.DROP)
    front = poses[drops, :2] + symmetries.DIRECTION_VECTORS[poses[drops, 2]]
    front = front.clip(0, needed.shape[1] - 1)  # a user's data may face out of the grid
    needed[drops, front[:, 0], front[:, 1]] = True
    return np.logical_or.accumulate(needed[::-1])[::-1][:-1]


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
        steps.way[index],
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
