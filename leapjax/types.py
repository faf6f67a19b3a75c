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
    """What a plan is conditioned on (paper, section 3: the trajectory context and s_n).

    Attributes:
        observation: the current state s_n.
        past: `[K, ...]` the K states before it, oldest first; zeros before the start.
        actions: `[K]` int32, the action taken in each past state; PAD before the start.
        rewards: `[K]` float32, what each of them gave; 0 before the start.
        step: `[]` int32, environment steps since the episode began.
        return_so_far: `[]` float32, the sum of all rewards since then.
    """

    observation: PyTree
    past: PyTree
    actions: Array
    rewards: Array
    step: Array
    return_so_far: Array


class Demonstration(NamedTuple):
    """One episode of `n` steps, played by somebody.

    Attributes:
        observations: `[n + 1, ...]` the state before each action, and the last.
        actions: `[n]` int32.
        rewards: `[n]` float32.
        terminated: the episode came to an end of its own.
        truncated: the episode was cut off, by a limit of steps for instance. The end action is
            learned to follow, as after any other; the last state keeps its value.
        seed: with which the environment was reset.
    """

    observations: PyTree
    actions: Array
    rewards: Array
    terminated: bool
    truncated: bool
    seed: int


class Window(NamedTuple):
    """One training example: what was done from one step of a demonstration on.

    Attributes:
        context: at that step.
        actions: `[T]` int32, what was done.
        imitated: `[T]` bool, which of them to learn; the others are only shown.
        return_to_go: `[]` float32, the demonstration's rewards from this step on.
        extras: what the domain's augmentation must know of this step; no model sees it.
    """

    context: Context
    actions: Array
    imitated: Array
    return_to_go: Array
    extras: PyTree


class TransitionWindow(NamedTuple):
    """A step that was taken, and what came of it: for methods that learn from rewards.

    Attributes:
        context: after the step, one step longer than a network's: its last past step is this one.
        terminated: `[]` bool, the episode came to its end with the step.
    """

    context: Context
    terminated: Array


class Plan(NamedTuple):
    """What a planner returns, for one context.

    Attributes:
        actions: `[T]` int32.
        trace: `[N, T]` int32, the actions after every iteration.
        satisfied: `[]` bool, no constraint of the energy is violated.
        valid: `[]` bool, no energy met on the way was NaN or -inf.
        passes: `[]` int32, passes of the model that the plan took: one for each conditional of each
            restart or beam, T for each total energy.
        energy: `[]` float32, of the plan; only if asked for (`score`), since it costs T passes.
        trace_energies: `[N]` float32, after every iteration; only if asked for (`score_trace`),
            since it costs N * T passes.
    """

    actions: jax.Array
    trace: jax.Array
    satisfied: jax.Array
    valid: jax.Array
    passes: jax.Array
    energy: jax.Array | None = None
    trace_energies: jax.Array | None = None


def no_violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
    """That of an energy without constraints: 0."""
    del params, memory, actions
    return jnp.zeros(())


class Energy(NamedTuple):
    """An energy over plans: pure functions of one trajectory, to be `vmap`ped outside.

    Tokens: actions are `0 .. A-1`; `A` is MASK (see `mask_token`), legal only where
    `accepts_mask`; `A + 1` is PAD (see `pad_token`), legal only in a context.

    Attributes:
        encode: (params, context) -> memory; computed once per plan.
        conditional: (params, memory, actions `[T]`, positions `[P]`) -> `[P, A]`, the energy of
            each action at each position, up to a constant per position; a model masks all P
            positions together.
        total: (params, memory, actions `[T]`) -> `[]`, the energy of a complete plan.
        num_actions: A, the end action included.
        accepts_mask: whether actions may be MASK; if not, planning starts from uniform actions.
        violation: (params, memory, actions `[T]`) -> `[]`, 0 where every constraint holds, else
            positive; +inf for a plan that is forbidden. For a plan that holds MASK: positive only
            if every way to complete it breaks a constraint.
    """

    encode: Callable[[Params, PyTree], PyTree]
    conditional: Callable[[Params, PyTree, jax.Array, jax.Array], jax.Array]
    total: Callable[[Params, PyTree, jax.Array], jax.Array]
    num_actions: int
    accepts_mask: bool = True
    violation: Callable[[Params, PyTree, jax.Array], jax.Array] = no_violation


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
    """All that training changes.

    Attributes:
        params: of the energy.
        optimizer: the optimizer's own state.
        step: `[]` int32, updates done.
        extra: what no gradient touches: target networks, running statistics.
    """

    params: Params
    optimizer: PyTree
    step: jax.Array
    extra: PyTree = ()


EncodeNext = Callable[[Params, Context, PyTree], tuple[PyTree, PyTree]]
# (params, context, cache) -> (memory, cache): as an energy's `encode`, for consecutive states of an
# episode. The cache is what the network keeps from plan to plan; None at the first


class Agent(NamedTuple):
    """What every method has in common, so that one training and one rollout serve all.

    Attributes:
        init: (key) -> state.
        batch: (key, steps) -> batch `[B, ...]`; pure; `leapjax.data.windows` makes the steps.
        update: (state, batch, key) -> (state, metrics); pure, not jitted; splits the batch itself.
        energy: what is minimised to act; a method that chooses one action at a time has plans of
            one.
        encode_next: `energy.encode` with a cache, for `compile_planner`; None: a cache would save
            nothing.
    """

    init: Callable[[jax.Array], TrainState]
    batch: Callable[[jax.Array, PyTree], PyTree]
    update: Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]
    energy: Energy
    encode_next: EncodeNext | None = None
