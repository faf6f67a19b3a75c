"""The data that everything else passes around. Nothing here computes, or knows a domain.

Shape letters, used throughout: B plans or windows in a batch, T planned actions (the
horizon), K past steps in a context, N planning iterations, P positions resampled
together, A actions (the end action included).
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from leapjax.checks import MOST, check_integer

PyTree = Any
Params = Any
Array = Any  # a jax.Array inside a program, a NumPy array at its edges


def to_plain_dicts(observation: PyTree) -> PyTree:
    """Replaces mappings of any kind by dicts: to `jax.tree` each kind is another structure."""
    if isinstance(observation, Mapping):
        return {key: to_plain_dicts(part) for key, part in observation.items()}
    if isinstance(observation, tuple | list):  # which may hold mappings
        return jax.tree.map(to_plain_dicts, observation, is_leaf=lambda x: isinstance(x, Mapping))
    return observation


class Context(NamedTuple):
    """What a plan is conditioned on (paper, section 3: the trajectory context and s_n)."""

    observation: PyTree  # the current state s_n
    past: PyTree  # [K, ...] the K states before it, oldest first; zeros before the start
    actions: Array  # [K] int32: the action taken in each past state; PAD before the start
    rewards: Array  # [K] float32: what each of them gave; 0 before the start
    step: Array  # [] int32: environment steps since the episode began
    return_so_far: Array  # [] float32: the sum of all rewards since then


class Demonstration(NamedTuple):
    """One episode of `n` steps, played by somebody."""

    observations: PyTree  # [n + 1, ...] the state before each action, and the last
    actions: Array  # [n] int32
    rewards: Array  # [n] float32
    terminated: bool  # it came to an end of its own
    truncated: bool  # it was cut off, by a limit of steps for instance; what is then learned to
    # follow is the end action, as after any other, but its last state keeps its value
    seed: int  # with which the environment was reset


class Window(NamedTuple):
    """One training example: what was done from one step of a demonstration on."""

    context: Context
    actions: Array  # [T] int32: what was done
    imitated: Array  # [T] bool: which of them to learn; the others are only shown
    return_to_go: Array  # [] float32: the demonstration's rewards from this step on
    extras: PyTree  # what the domain's augmentation must know of this step; no model sees it


class TransitionWindow(NamedTuple):
    """A step that was taken, and what came of it: for methods that learn from rewards."""

    context: Context  # after it, one step longer than a network's: it holds the step as its last
    terminated: Array  # [] bool: the episode came to its end with it


class Plan(NamedTuple):
    """What a planner returns, for one context."""

    actions: jax.Array  # [T] int32
    trace: jax.Array  # [N, T] int32: the actions after every iteration
    satisfied: jax.Array  # [] bool: no constraint of the energy is violated
    valid: jax.Array  # [] bool: no energy met on the way was NaN
    energy: jax.Array | None = None  # [] float32, only if asked for: it costs T passes
    trace_energies: jax.Array | None = None  # [N] float32, only if asked for: N * T passes


def no_violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
    """That of an energy without constraints: 0."""
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
    # each position, up to a constant per position; a model's masks all P positions together
    total: Callable[[Params, PyTree, jax.Array], jax.Array]
    # (params, memory, actions [T]) -> []: the energy of a complete plan
    num_actions: int  # A, the end action included
    accepts_mask: bool = True  # False: planning starts from uniform actions, not from MASK
    violation: Callable[[Params, PyTree, jax.Array], jax.Array] = no_violation
    # (params, memory, actions [T]) -> []: 0 where every constraint holds, else positive


def mask_token(num_actions: int) -> int:
    """The token of an action that is not chosen yet."""
    return check_num_actions(num_actions)


def pad_token(num_actions: int) -> int:
    """The token of a past action that never was: the episode had not begun."""
    return check_num_actions(num_actions) + 1


def check_num_actions(num_actions: int) -> int:
    """Returns A, the end action included.

    Raises:
        UserError: not an integer, or out of range.
    """
    return check_integer("num_actions", num_actions, 1, MOST - 1)  # PAD is one more


class TrainState(NamedTuple):
    """All that training changes."""

    params: Params
    optimizer: PyTree
    step: jax.Array  # [] int32: updates done
    extra: PyTree = ()  # what no gradient touches: target networks, running statistics


EncodeNext = Callable[[Params, Context, PyTree], tuple[PyTree, PyTree]]
# (params, context, cache) -> (memory, cache): as an energy's `encode`, for consecutive states of an
# episode. The cache is what the network keeps from plan to plan; None at the first


class Agent(NamedTuple):
    """What every method has in common, so that one training and one rollout serve all."""

    init: Callable[[jax.Array], TrainState]
    # (key) -> state
    batch: Callable[[jax.Array, PyTree], PyTree]
    # (key, steps) -> batch [B, ...]; pure; see leapjax.data.windows for the steps
    update: Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]
    # (state, batch, key) -> (state, metrics); pure, not jitted; splits the batch itself
    energy: Energy
    # what is minimised to act; a method that chooses one action at a time has plans of one
    encode_next: EncodeNext | None = None
    # `energy.encode` with a cache, for `compile_planner`; None: a cache would save nothing
