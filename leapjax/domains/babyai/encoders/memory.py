"""Marks cells by what the agent did in its context, and by what may open a locked door.

Deeds show what part of a task is done. The marks leave out most of the agent's path and its past
turns and moves, because a network could recognise a demonstration by them. All grids are turned so
that the agent faces right.
"""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.adapter import ACTIONS, NUM_ACTIONS
from leapjax.domains.babyai.dynamics import DOOR, LOCKED
from leapjax.domains.babyai.encoders.cells import COLOURS, OBJECTS, mark_cell
from leapjax.domains.babyai.observations import Observation
from leapjax.types import Context, pad_token

DEEDS = tuple(ACTIONS.index(name) for name in ("pickup", "drop", "toggle"))


def mark_faced(context: Context, turned: jax.Array) -> jax.Array:
    """Marks the objects and doors that the agent has faced in the context: `[S, S, 2]`.

    The first feature is 1 on these cells. The second says how recently the agent faced them, in
    (0, 1], where 1 is now.

    Args:
        context: context with K past steps.
        turned: current grid `[S, S, 3]`, turned so that the agent faces right.
    """
    poses = jnp.concatenate([context.past.pose, context.observation.pose[None]])
    recency = jnp.append(_measure_recency(context), 1.0)
    named = symmetries.is_coloured(turned[..., 0])
    latest = _mark_fronts(context, poses, recency, turned.shape[0]) * named
    return jnp.stack([latest > 0, latest], axis=-1)


def recall(context: Context, turned: Observation) -> jax.Array:
    """Joins what cells show of the past: deeds, sides, what opens locked doors, the carried object.

    Args:
        context: context with K past steps.
        turned: current observation, turned so that the agent faces right.

    Returns:
        Features `[S, S, 23]`.
    """
    side = turned.grid.shape[0]
    kind, colour = turned.carried
    held = jnp.append(jax.nn.one_hot(kind, OBJECTS), jax.nn.one_hot(colour, COLOURS)) * (kind > 0)
    marks = mark_cell(turned.pose[:2], side)[..., None] * held
    return jnp.concatenate(
        [mark_deeds(context, side), mark_sides(context, side), marks, mark_matches(turned)], axis=-1
    )


def mark_deeds(context: Context, side: int) -> jax.Array:
    """Marks where the agent picked up, dropped and toggled in the context: `[S, S, 3]`.

    The features say how recently it did each, in (0, 1); 0 is never.

    Args:
        context: context with K past steps.
        side: S.
    """
    recency = _measure_recency(context)
    marks = [
        _mark_fronts(context, context.past.pose, recency * (context.actions == deed), side)
        for deed in DEEDS
    ]
    return jnp.stack(marks, axis=-1)


def mark_sides(context: Context, side: int) -> jax.Array:
    """Marks the cells ahead of the context's first pose, and on its right: `[S, S, 2]`, -1, 0, 1.

    Instructions say "in front of you" or "on your left", as seen from the first state.

    Args:
        context: context with K past steps, of which the first that is known counts.
        side: S.
    """
    poses = jnp.concatenate([context.past.pose, context.observation.pose[None]])
    known = jnp.append(_measure_recency(context) > 0, True)
    first = poses[jnp.argmax(known)]
    x, y, direction = symmetries.rotate_pose(first, context.observation.pose[2], side)
    ahead = jnp.asarray(symmetries.DIRECTION_VECTORS)[direction]
    axis = jnp.arange(side)
    across, along = (axis - x)[:, None], (axis - y)[None, :]
    front = across * ahead[0] + along * ahead[1]
    right = along * ahead[0] - across * ahead[1]
    return jnp.sign(jnp.stack([front, right], axis=-1)).astype(jnp.float32)


def mark_matches(observation: Observation) -> jax.Array:
    """Marks doors and objects of the colour of a locked door: `[S, S, 1]`.

    It marks the agent if it carries one. "Open the door" does not name the colour of the key.

    Args:
        observation: current observation.
    """
    kinds, colours, states = jnp.moveaxis(jnp.asarray(observation.grid), -1, 0)
    locked = (kinds == DOOR) & (states == LOCKED)
    coloured = jax.nn.one_hot(colours, COLOURS)
    wanted = (coloured * locked[..., None]).max(axis=(0, 1))
    kind, colour = observation.carried
    there = (coloured @ wanted) * symmetries.is_coloured(kinds)
    held = mark_cell(observation.pose[:2], kinds.shape[0]) * wanted[colour] * (kind > 0)
    return (there + held)[..., None]


def _measure_recency(context: Context) -> jax.Array:
    """Returns how recent each past step is: `[K]` in (0, 1); 0 before the episode began."""
    past = context.actions.shape[0]
    known = context.actions != pad_token(NUM_ACTIONS)
    return known * jnp.arange(1, past + 1) / (past + 1)


def _mark_fronts(context: Context, poses: jax.Array, values: jax.Array, side: int) -> jax.Array:
    """Marks the cells in front of poses with the largest of their values: `[S, S]`, else 0.

    Args:
        context: context, in whose turned grid the cells lie.
        poses: poses `[n, 3]`, not turned.
        values: `[n]`, not negative; 0 before the episode began.
        side: S.
    """
    quarters = context.observation.pose[2]
    turned = jax.vmap(symmetries.rotate_pose, (0, None, None))(poses, quarters, side)
    fronts = turned[:, :2] + jnp.asarray(symmetries.DIRECTION_VECTORS)[turned[:, 2]]
    return jnp.zeros((side, side)).at[fronts[:, 0], fronts[:, 1]].max(values, mode="drop")
