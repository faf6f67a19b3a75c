"""The data that everything else passes around. Nothing here computes.

Shape letters, used throughout: B plans or windows in a batch, T planned actions (the
horizon), K past steps in a context, N planning iterations, P positions resampled
together, A actions (the end action included), S grid side, L instruction tokens.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

PyTree = Any
Params = Any
Array = Any  # a jax.Array inside a program, a NumPy array at its edges


class Observation(NamedTuple):
    """One state of a grid world, as numbers. Positions are `[x, y]`, `grid[x, y]`."""

    grid: Array  # [S, S, 3] uint8: object, colour and state of every cell, agent included
    pose: Array  # [3] int32: x, y, direction (0 right, 1 down, 2 left, 3 up)
    carried: Array  # [2] int32: object and colour held; (0, 0) is nothing
    goal: Array  # [2] int32: x, y of the target; (-1, -1) where it is not available
    instruction: Array  # [L] int32: token ids; 0 pads on the right


class Context(NamedTuple):
    """What a plan is conditioned on (paper, section 3: the trajectory context and s_n)."""

    observation: PyTree  # the current state s_n
    past: PyTree  # [K, ...] the K states before it, oldest first; zeros before the start
    actions: Array  # [K] int32: the action taken in each past state; PAD before the start
    step: Array  # [] int32: environment steps since the episode began


class Plan(NamedTuple):
    """What a planner returns, for one context."""

    actions: jax.Array  # [T] int32
    trace: jax.Array  # [N, T] int32: the actions after every iteration
    satisfied: jax.Array  # [] bool: no constraint of the energy is violated
    valid: jax.Array  # [] bool: no energy met on the way was NaN
    energy: jax.Array | None = None  # [] float32, only if asked for: it costs T passes
    trace_energies: jax.Array | None = None  # [N] float32, only if asked for: N * T passes


def _no_violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
    del params, memory, actions
    return jnp.zeros(())


class Energy(NamedTuple):
    """An energy over plans: pure functions of one trajectory, to be `vmap`ped outside.

    Tokens: actions are `0 .. A-1`; `A` is MASK (see `mask_token`), legal only where
    `accepts_mask`; `A + 1` is PAD (see `pad_token`), legal only in a context.
    """

    encode: Callable[[Params, PyTree], PyTree]
    # (params, context) -> memory; computed once per plan
    conditional: Callable[[Params, PyTree, jax.Array, jax.Array], jax.Array]
    # (params, memory, actions [T], positions [P]) -> [P, A]: the energy of each action at
    # each position, up to a constant per position; all P positions are masked together
    total: Callable[[Params, PyTree, jax.Array], jax.Array]
    # (params, memory, actions [T]) -> []: the energy of a complete plan
    num_actions: int  # A, the end action included
    accepts_mask: bool = True  # False: planning starts from uniform actions, not from MASK
    violation: Callable[[Params, PyTree, jax.Array], jax.Array] = _no_violation
    # (params, memory, actions [T]) -> []: 0 where every constraint holds, else positive


def mask_token(num_actions: int) -> int:
    """The token of an action that is not chosen yet."""
    return num_actions


def pad_token(num_actions: int) -> int:
    """The token of a past action that never was: the episode had not begun."""
    return num_actions + 1


class TrainState(NamedTuple):
    """All that training changes."""

    params: Params
    optimizer: PyTree
    step: jax.Array  # [] int32: updates done


class Agent(NamedTuple):
    """What every method has in common, so that one training and one rollout serve all."""

    init: Callable[[jax.Array], TrainState]
    # (key) -> state
    update: Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]
    # (state, batch, key) -> (state, metrics); pure, not jitted; splits the batch itself
    energy: Energy | None
    # the energy that `act` minimises, for composition; None for methods without one
    act: Callable[[Params, jax.Array, PyTree], Plan]
    # (params, key, context) -> plan; pure, one context
