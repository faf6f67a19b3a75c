"""Data types that all modules share, for any domain.

Letters of shapes, in all modules:

- B: plans or windows in a batch.
- T: planned actions (the horizon).
- K: past steps in a context.
- N: planning iterations.
- P: positions resampled together.
- A: actions, the end action included.
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
    """Replaces mappings by dicts: `jax.tree` tells different kinds of mappings apart."""
    if isinstance(observation, Mapping):
        return {key: to_plain_dicts(part) for key, part in observation.items()}
    if isinstance(observation, tuple | list):  # may hold mappings
        return jax.tree.map(to_plain_dicts, observation, is_leaf=lambda x: isinstance(x, Mapping))
    return observation


class Context(NamedTuple):
    """The input of a planner (paper, section 3: the trajectory context and s_n).

    Attributes:
        observation: the current state s_n.
        past: `[K, ...]` the K states before it, oldest first; zeros before the start.
        actions: `[K]` int32, the action taken in each past state; PAD before the start.
        rewards: `[K]` float32, the reward of each of these actions; 0 before the start.
        step: `[]` int32, environment steps since the episode began.
        return_so_far: `[]` float32, the sum of all rewards since the episode began.
    """

    observation: PyTree
    past: PyTree
    actions: Array
    rewards: Array
    step: Array
    return_so_far: Array


class Demonstration(NamedTuple):
    """One episode of `n` steps, played by a demonstrator.

    Attributes:
        observations: `[n + 1, ...]` the state before each action, and the last state.
        actions: `[n]` int32.
        rewards: `[n]` float32.
        terminated: whether the episode came to an end of its own.
        truncated: whether the episode was cut off, for instance by a step limit. As after any
            episode, models learn to plan the end action; the last state keeps its value.
        seed: seed of the environment's reset.
    """

    observations: PyTree
    actions: Array
    rewards: Array
    terminated: bool
    truncated: bool
    seed: int


class Window(NamedTuple):
    """One training example: a step of a demonstration, and the actions from this step on.

    Attributes:
        context: the context at this step.
        actions: `[T]` int32, the demonstrated actions.
        imitated: `[T]` bool, which actions to learn; a model only sees the others.
        return_to_go: `[]` float32, the sum of the demonstration's rewards from this step on.
        extras: data of this step for the domain's augmentations; no model sees them.
    """

    context: Context
    actions: Array
    imitated: Array
    return_to_go: Array
    extras: PyTree


class TransitionWindow(NamedTuple):
    """One step and its outcome, for methods that learn from rewards.

    Attributes:
        context: the context after the step, with K + 1 past steps; the step is the last of them.
        terminated: `[]` bool, whether the step terminated the episode.
    """

    context: Context
    terminated: Array


class Plan(NamedTuple):
    """The result of a planner, for one context.

    Attributes:
        actions: `[T]` int32.
        trace: `[N, T]` int32, the actions after every iteration.
        satisfied: `[]` bool, whether all constraints of the energy hold.
        valid: `[]` bool, whether no energy met during planning was NaN or -inf.
        passes: `[]` int32, passes of the model: one for each conditional of each restart or beam, T
            for each total energy.
        energy: `[]` float32, energy of the plan; only with `score`, since it costs T passes.
        trace_energies: `[N]` float32, energy after every iteration; only with `score_trace`, since
            it costs N * T passes.
    """

    actions: jax.Array
    trace: jax.Array
    satisfied: jax.Array
    valid: jax.Array
    passes: jax.Array
    energy: jax.Array | None = None
    trace_energies: jax.Array | None = None


def no_violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
    """Returns 0, the violation of an energy without constraints."""
    del params, memory, actions
    return jnp.zeros(())


def no_turn(params: Params, key: jax.Array, memory: PyTree) -> PyTree:
    """Returns the same memory: the energy knows no symmetry of its contexts."""
    del params, key
    return memory


class Turned(NamedTuple):
    """A context in another form: the same task after a symmetry, such as rows in another order.

    Position t of a plan for the turned context has the action that a plan for the original context
    has at position `places[t]`, under another name.

    Attributes:
        context: the turned context.
        places: `[T]` int32, a permutation of the positions.
        names: `[T, A]` int32: action a at position t of the original plan has the name
            `names[t, a]` in the turned one. Each row is a permutation of the actions.
    """

    context: PyTree
    places: jax.Array
    names: jax.Array


class Energy(NamedTuple):
    """An energy over plans: pure functions of one trajectory, which callers `vmap`.

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
        left_to_right: whether actions may be MASK from the queried position on, if not elsewhere:
            the energy reads earlier actions only.
        violation: (params, memory, actions `[T]`) -> `[]`, 0 where every constraint holds, else
            positive; +inf for a plan that is forbidden. For a plan that holds MASK: positive only
            if every way to complete it breaks a constraint.
        turn: (params, key, memory) -> memory of the same context after a random symmetry, see
            `leapjax.energy.symmetric`. Plans and energies keep their form.
    """

    encode: Callable[[Params, PyTree], PyTree]
    conditional: Callable[[Params, PyTree, jax.Array, jax.Array], jax.Array]
    total: Callable[[Params, PyTree, jax.Array], jax.Array]
    num_actions: int
    accepts_mask: bool = True
    violation: Callable[[Params, PyTree, jax.Array], jax.Array] = no_violation
    turn: Callable[[Params, jax.Array, PyTree], PyTree] = no_turn
    left_to_right: bool = False


def mask_token(num_actions: int) -> int:
    """Returns the token of an action that is not chosen yet, MASK."""
    return check_num_actions(num_actions)


def pad_token(num_actions: int) -> int:
    """Returns the token of past actions before the episode began, PAD."""
    return check_num_actions(num_actions) + 1


def check_num_actions(num_actions: int) -> int:
    """Checks A, the end action included, and returns it as an `int`.

    Raises:
        UserError: A is not an integer, or out of range.
    """
    return check_integer("num_actions", num_actions, 1, MOST - 1)  # PAD, A + 1, must be an int32


class TrainState(NamedTuple):
    """Everything that training changes.

    Attributes:
        params: parameters of the energy.
        optimizer: state of the optimizer.
        step: `[]` int32, number of updates so far.
        extra: arrays that gradients do not change: target networks, running statistics.
    """

    params: Params
    optimizer: PyTree
    step: jax.Array
    extra: PyTree = ()


EncodeNext = Callable[[Params, Context, PyTree], tuple[PyTree, PyTree]]
# (params, context, cache) -> (memory, cache): `encode` for consecutive states of an episode. The
# network keeps the cache from plan to plan; for the first plan it is `None`.


class Agent(NamedTuple):
    """The interface of all methods: one training loop and one rollout serve them all.

    Attributes:
        init: (key) -> state.
        batch: (key, steps) -> batch `[B, ...]`; pure; `leapjax.data.windows` makes the steps.
        update: (state, batch, key) -> (state, metrics); pure, not jitted; it splits the batch over
            the devices itself.
        energy: the energy to minimise; T = 1 if the method chooses one action at a time.
        encode_next: `energy.encode` with a cache, for `compile_planner`; `None` if a cache would
            save no work.
    """

    init: Callable[[jax.Array], TrainState]
    batch: Callable[[jax.Array, PyTree], PyTree]
    update: Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]
    energy: Energy
    encode_next: EncodeNext | None = None
