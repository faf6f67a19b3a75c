"""Energies over plans and their algebra: every function here returns an `Energy`.

An energy is written for one trajectory. Parameters are an argument and varying data lives in the
context, so an energy is built once and compiled once. Actions and positions that are not integers
raise `ValueError`. Outside of `jit`, so do integers out of range, and energies that are NaN. Inside
of `jit` values are unknown; there the field `valid` of a plan tells.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import (
    check_floats,
    check_indices,
    check_integer,
    check_kind,
    check_numbers,
)
from leapjax.errors import UserError
from leapjax.types import (
    Array,
    Energy,
    Params,
    PyTree,
    Turned,
    check_num_actions,
    mask_token,
    no_turn,
    no_violation,
)

EncodeFn = Callable[[Params, PyTree], PyTree]
LogitsFn = Callable[[Params, PyTree, jax.Array, jax.Array], jax.Array]
TotalFn = Callable[[Params, PyTree, jax.Array], jax.Array]
ConditionalFn = Callable[[Params, PyTree, jax.Array, jax.Array], jax.Array]


def pseudo_likelihood(encode: EncodeFn, logits: LogitsFn, num_actions: int) -> Energy:
    """The energy of a masked language model over actions (paper, equation 2).

    `total` is the negative pseudo-log-likelihood, the sum over t of
    `-log p(a_t | context, a_-t)`, with all T masked copies scored in one batched pass.
    `conditional` is each term on its own. These are two different objects: the
    conditionals of `exp(-total)` are not the model's conditionals, so an update that is
    greedy in the conditionals can raise `total`.

    Args:
        encode: (params, context) -> memory.
        logits: (params, memory, tokens `[T]` with MASK, positions `[P]`) -> `[P, A]`
            unnormalised log-probabilities; -inf forbids an action.
        num_actions: A, the end action included.
    """
    mask = mask_token(num_actions)

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, num_actions)
        tokens = actions.at[positions].set(mask)
        scores = logits(params, memory, tokens, positions)
        scores = check_floats("logits", scores, (positions.shape[0], num_actions))
        return _check_energies(-jax.nn.log_softmax(scores, axis=-1), positions)

    total = _sum_of_conditionals(conditional, num_actions)
    return Energy(encode, conditional, total, check_num_actions(num_actions))


def autoregressive(encode: EncodeFn, logits: LogitsFn, num_actions: int) -> Energy:
    """The energy of a model that chooses actions from left to right.

    `total` is the negative log-likelihood of the plan. `conditional` is one term of it: the energy
    of an action given the actions before it, so only later actions may be MASK. `beam_search` is
    the planner for it.

    Args:
        encode: (params, context) -> memory.
        logits: (params, memory, tokens `[T]`, positions `[P]`) -> `[P, A]` unnormalised
            log-probabilities, which depend on the tokens before the position only; -inf forbids
            an action.
        num_actions: A, the end action included.
    """

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, num_actions)
        scores = logits(params, memory, actions, positions)
        scores = check_floats("logits", scores, (positions.shape[0], num_actions))
        return _check_energies(-jax.nn.log_softmax(scores, axis=-1), positions)

    def total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)
        energies = conditional(params, memory, actions, jnp.arange(actions.shape[0]))
        chosen = jnp.minimum(actions, num_actions - 1)[:, None]
        energy = jnp.take_along_axis(energies, chosen, axis=1).sum()
        return _infinite_if_incomplete(_check_total(energy), actions, num_actions)

    num_actions = check_num_actions(num_actions)
    return Energy(encode, conditional, total, num_actions, accepts_mask=False, left_to_right=True)


def from_total(encode: EncodeFn, total: TotalFn, num_actions: int) -> Energy:
    """An energy from its total alone: any function of a complete plan will do.

    The conditional tries every action at every position and keeps the rest of the plan, `P * A`
    evaluations. It accepts no MASK, so planners start from uniform actions.

    Args:
        encode: (params, context) -> memory.
        total: (params, memory, actions `[T]`) -> `[]`, lower is better; +inf forbids.
        num_actions: A.
    """

    def guarded_total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)
        energy = check_floats("a total", total(params, memory, actions), ())
        energy = jnp.asarray(energy, jnp.float32)
        return _infinite_if_incomplete(_check_total(energy), actions, num_actions)

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, num_actions)
        energies = _try_every_action(
            lambda plan: guarded_total(params, memory, plan), actions, positions, num_actions
        )
        return _check_energies(energies, positions)

    return Energy(
        encode, conditional, guarded_total, check_num_actions(num_actions), accepts_mask=False
    )


def single_action(
    encode: EncodeFn, scores: Callable[[Params, PyTree], jax.Array], num_actions: int
) -> Energy:
    """The energy of a method that chooses one action at a time, over plans of one action.

    The lowest energy is the best action, and a sample at temperature 1 is a sample of the
    policy whose logits the scores are. The end action, the last one, is never chosen.

    Args:
        encode: (params, context) -> memory.
        scores: (params, memory) -> `[A - 1]` logits or Q-values; -inf forbids an action.
        num_actions: A, the end action included.
    """

    def energies(params: Params, memory: PyTree) -> jax.Array:
        values = check_floats("scores", scores(params, memory), (num_actions - 1,))
        return jnp.append(-values, jnp.inf)

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, num_actions)
        _check_single(actions)
        return _check_energies(energies(params, memory)[None], positions)

    def total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)
        _check_single(actions)
        energy = energies(params, memory)[jnp.minimum(actions[0], num_actions - 1)]
        return _infinite_if_incomplete(_check_total(energy), actions, num_actions)

    return Energy(encode, conditional, total, check_num_actions(num_actions))


def _check_single(actions: jax.Array) -> None:
    if actions.shape != (1,):
        raise ValueError(
            f"a plan of shape {actions.shape}: this method chooses one action at a time, so its "
            "horizon is 1"
        )


class Factors(NamedTuple):
    """The terms of an energy; each term reads a few positions of a plan.

    Attributes:
        positions: `[M, S]` integers in 0 .. T - 1, the positions that each of M terms reads; a term
            with fewer positions repeats some.
        data: leaves `[M, ...]`, further numbers of each term, or `()`.
    """

    positions: Array
    data: PyTree = ()


def from_factors(
    encode: Callable[[Params, PyTree], Factors],
    term: Callable[[Params, PyTree, jax.Array], jax.Array],
    num_actions: int,
    degree: int,
    accepts_mask: bool = False,
) -> Energy:
    """Makes an energy from a sum of local terms, such as the edges of a graph to colour.

    The conditional evaluates only terms that read the queried positions: `P * A * degree`
    evaluations of a term. It equals the conditional of `from_total`, up to a constant per position.

    Args:
        encode: (params, context) -> the terms.
        term: (params, data of one term, actions `[S]` at its positions) -> `[]`, lower is better;
            +inf forbids.
        num_actions: A.
        degree: the largest number of terms that read one position.
        accepts_mask: whether the term takes MASK, the number of actions: for example 0 as long as
            the open actions can satisfy it.

    Raises:
        ValueError: `degree` is less than 1. Conditionals and totals raise it if positions are out
            of range or more than `degree` terms read one. Inside of `jit`, where values are
            unknown, these energies are NaN.
    """
    check_integer("degree", degree, 1)
    mask = mask_token(num_actions)

    def evaluate(params: Params, data: PyTree, actions: jax.Array) -> jax.Array:
        return check_floats("a term", term(params, data, actions), ())

    def conditional(
        params: Params, memory: Factors, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, num_actions)
        memory, fits = _check_factors(memory, actions.shape[0], degree)
        # Terms that take MASK see all queried positions masked; others see the whole plan.
        tokens = actions.at[positions].set(mask) if accepts_mask else actions

        def at(position: jax.Array) -> jax.Array:
            touches = jnp.any(memory.positions == position, axis=1)
            count = min(degree, touches.shape[0])
            found = jax.lax.top_k(touches.astype(jnp.int32), count)[1]
            reads, data = jax.tree.map(lambda leaf: jnp.asarray(leaf)[found], tuple(memory))

            def sum_terms(action: jax.Array) -> jax.Array:
                tried = tokens.at[position].set(action)[reads]  # [degree, S]
                terms = jax.vmap(evaluate, in_axes=(None, 0, 0))(params, data, tried)
                return jnp.where(touches[found], terms, 0).sum()

            energies = jax.vmap(sum_terms)(jnp.arange(num_actions))
            return jnp.where(fits & (touches.sum() <= degree), energies, jnp.nan)

        return _check_energies(jax.vmap(at)(positions), positions)

    def total(params: Params, memory: Factors, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)
        memory, fits = _check_factors(memory, actions.shape[0], degree)
        reads = actions[memory.positions]  # [M, S]
        terms = jax.vmap(evaluate, in_axes=(None, 0, 0))(params, memory.data, reads)
        energy = _check_total(jnp.where(fits, terms.sum(), jnp.nan))
        return _infinite_if_incomplete(energy, actions, num_actions)

    return Energy(
        encode, conditional, total, check_num_actions(num_actions), accepts_mask=accepts_mask
    )


def _check_factors(factors: Factors, horizon: int, degree: int) -> tuple[Factors, jax.Array]:
    """Checks the positions of terms.

    Returns:
        The terms, positions as an array of JAX, and whether all positions are in the plan.

    Raises:
        ValueError: see `from_factors`.
    """
    positions = jnp.asarray(check_kind(factors, Factors).positions)
    if positions.ndim != 2 or not jnp.issubdtype(positions.dtype, jnp.integer):
        raise UserError(
            "the positions of factors must be integers of shape [terms, positions of a term], got "
            f"{positions.dtype}{list(positions.shape)}"
        )
    if not isinstance(positions, jax.core.Tracer):
        expected = f"0 .. {horizon - 1}, the horizon is {horizon}"
        _check_integers("positions of factors", positions.reshape(-1), horizon, expected)
        counts = np.zeros(horizon, int)
        for row in np.asarray(positions):
            counts[row] += 1  # once, also if a term repeats a position
        if counts.max() > degree:
            raise UserError(
                f"{counts.max()} terms read position {counts.argmax()}, and degree is {degree}: "
                f"degree must be at least {counts.max()}"
            )
    return factors._replace(positions=positions), jnp.all((positions >= 0) & (positions < horizon))


def classifier(encode: EncodeFn, degree: TotalFn, num_actions: int) -> Energy:
    """The energy of a sequence classifier (paper, appendix, ablation).

    The classifier estimates how corrupted a whole plan is, so a demonstrator's plan has the least
    energy. `leapjax.agents.classifier` trains the paper's LSTM.

    Args:
        encode: (params, context) -> memory.
        degree: (params, memory, actions `[T]`) -> `[]`, the degree of corruption.
        num_actions: A.
    """
    return from_total(encode, degree, num_actions)


def compose(energies: Sequence[Energy], weights: Sequence[float] | None = None) -> Energy:
    """The weighted sum of energies (paper, section 4, task compositionality).

    A weight is an inverse temperature: two is twice as sharp. Parameters and memories
    become tuples with one entry per energy. The constraints of every energy hold, whatever its
    weight: with weight 0 they do not guide the search, and `satisfied` still counts them.

    Raises:
        ValueError: no energies, different action sets, or weights that are negative, not
            finite or not as many as the energies.
    """
    if isinstance(energies, Energy):  # an energy is a tuple, too
        raise UserError("compose takes a sequence of energies, got one energy")
    energies = tuple(check_kind(energy, Energy) for energy in energies)
    if weights is None:
        weights = [1.0] * len(energies)
    weights = check_numbers("weights", weights, 0)
    if not energies:
        raise ValueError("compose needs at least one energy")
    if len(weights) != len(energies):
        raise ValueError(f"{len(energies)} energies need as many weights, got {len(weights)}")
    action_sets = {energy.num_actions for energy in energies}
    if len(action_sets) > 1:
        raise ValueError(
            f"composed energies must agree on one action set, got sizes {sorted(action_sets)}"
        )
    num_actions = energies[0].num_actions
    # Weight 0 leaves the values of an energy out: 0 * inf would be NaN. JAX rounds numbers below
    # `tiny` to 0.
    active = [index for index, weight in enumerate(weights) if weight >= np.finfo(np.float32).tiny]

    def encode(params: Params, context: PyTree) -> PyTree:
        counted = isinstance(params, Sequence) or bool(getattr(params, "shape", ()))
        if not counted or len(params) != len(energies):
            raise UserError(
                f"params of {len(energies)} composed energies must be a tuple of as many, got "
                f"{type(params).__name__}" + (f" of {len(params)}" if counted else "")
            )
        return tuple(energy.encode(p, context) for energy, p in zip(energies, params, strict=True))

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, num_actions)
        result = jnp.zeros((positions.shape[0], num_actions), jnp.float32)
        for i in active:
            result += weights[i] * energies[i].conditional(params[i], memory[i], actions, positions)
        return result

    def total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)
        result = jnp.zeros((), jnp.float32)
        for i in active:
            result += weights[i] * energies[i].total(params[i], memory[i], actions)
        return result

    def violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)
        result = jnp.zeros((), jnp.float32)
        for energy, p, own_memory in zip(energies, params, memory, strict=True):
            result += energy.violation(p, own_memory, actions)
        return result

    def turn(params: Params, key: jax.Array, memory: PyTree) -> PyTree:
        parts = zip(energies, params, memory, strict=True)
        return tuple(energy.turn(p, key, own_memory) for energy, p, own_memory in parts)

    accepts_mask = all(energies[i].accepts_mask for i in active)
    left_to_right = all(energies[i].accepts_mask or energies[i].left_to_right for i in active)
    free = all(energy.violation is no_violation for energy in energies)
    still = all(energy.turn is no_turn for energy in energies)
    return Energy(
        encode, conditional, total, num_actions, accepts_mask,
        no_violation if free else violation, no_turn if still else turn, left_to_right,
    )  # fmt: skip


def constrain(
    energy: Energy, penalty: Callable[[PyTree, jax.Array], jax.Array], partial: bool = False
) -> Energy:
    """Adds a test-time constraint (paper, section 4, online adaptation).

    The conditional tries every action at one position and keeps the rest of the plan. The penalty
    is a function of complete plans, so it counts only if the rest holds no MASK. The first
    iteration, with all positions masked, ignores it; later iterations obey it. A penalty that grows
    with the number of violations leads the search out of them one by one; +inf forbids plans, but
    gives the search no direction.

    A `partial` penalty also judges incomplete plans, by the actions that they have. Use it where
    `gibbs` or `beam_search` fills a plan position by position: a penalty of complete plans would
    count at the last position only.

    Args:
        energy: the energy to constrain.
        penalty: (context, actions `[T]`) -> `[]`: 0 or less for an allowed plan, positive for
            others. +inf forbids a plan.
        partial: whether the penalty takes plans that hold MASK, the number of actions.
    """
    complete = check_kind(energy, Energy).num_actions - 1  # the last action

    def judge(context: PyTree, plan: jax.Array) -> jax.Array:
        return check_floats("a penalty", penalty(context, plan), ())

    def judge_if_complete(context: PyTree, plan: jax.Array) -> jax.Array:
        """Returns the penalty; 0 for an incomplete plan, unless the penalty is `partial`."""
        if partial:
            return judge(context, plan)
        judged = judge(context, jnp.minimum(plan, complete))
        return jnp.where(jnp.all(plan <= complete), judged, 0.0)

    def encode(params: Params, context: PyTree) -> PyTree:
        return energy.encode(params, context), context

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        inner, context = memory
        actions, positions = _check_query(actions, positions, energy.num_actions)
        base = energy.conditional(params, inner, actions, positions)
        extra = _try_every_action(
            lambda plan: judge_if_complete(context, plan), actions, positions, energy.num_actions
        )
        # If every possible action at a position is forbidden, another position has to change. Then
        # this position ignores the constraint.
        both = base + extra
        hopeless = jnp.all(jnp.isposinf(both), axis=-1, keepdims=True)
        return _check_energies(jnp.where(hopeless, base, both), positions)

    def total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        inner, context = memory
        actions = _check_plan(actions, energy.num_actions)
        return _check_total(energy.total(params, inner, actions) + judge(context, actions))

    def violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        inner, context = memory
        actions = _check_plan(actions, energy.num_actions)
        # A negative penalty must not offset other violations.
        mine = jnp.maximum(judge_if_complete(context, actions), 0.0)
        return energy.violation(params, inner, actions) + mine

    def turn(params: Params, key: jax.Array, memory: PyTree) -> PyTree:
        inner, context = memory
        return energy.turn(params, key, inner), context

    return energy._replace(
        encode=encode, conditional=conditional, total=total, violation=violation,
        turn=no_turn if energy.turn is no_turn else turn,
    )  # fmt: skip


def view(energy: Energy, function: Callable[[PyTree], PyTree]) -> Energy:
    """Makes an energy that reads `function(context)` in place of the context.

    A constraint of the given energy also reads `function(context)`. To judge plans by the whole
    context, constrain the result of `view`.
    """

    def encode(params: Params, context: PyTree) -> PyTree:
        return energy.encode(params, function(context))

    return check_kind(energy, Energy)._replace(encode=encode)


class _Form(NamedTuple):
    """The memory of a symmetric energy: one form of a context.

    Attributes:
        context: the original context.
        memory: memory of the energy within, for this form.
        places: see `Turned`; `None` for the original context.
        names: see `Turned`.
    """

    context: PyTree
    memory: PyTree
    places: jax.Array | None = None
    names: jax.Array | None = None


def symmetric(energy: Energy, draw: Callable[[jax.Array, PyTree], Turned]) -> Energy:
    """Makes an energy that planners can read in other forms of the same context.

    A trained energy is rarely wrong in the same way about a board and about the board with its rows
    exchanged. So each restart of `gibbs` turns the context by a symmetry of its own, and the plan
    that the energy judges best is returned. Plans keep the positions and actions of the original
    context.

    Args:
        energy: energy within.
        draw: (key, context) -> the context after a random symmetry. Every plan that solves the
            original context, renamed, must solve the turned one.

    Raises:
        UserError: while it plans: `draw` returns no `Turned`, or one of other shapes or types.
    """
    num_actions = check_kind(energy, Energy).num_actions

    def encode(params: Params, context: PyTree) -> _Form:
        return _Form(context, energy.encode(params, context))

    def turn(params: Params, key: jax.Array, form: _Form) -> _Form:
        turned = _check_turned(draw(key, form.context), num_actions)
        return _Form(
            form.context, energy.encode(params, turned.context), turned.places, turned.names
        )

    def rename(form: _Form, actions: jax.Array) -> jax.Array:
        """Returns a plan `[T]` as the turned context has it; MASK stays MASK."""
        if form.places is None or form.names is None:
            return actions
        if actions.shape != form.places.shape:
            raise UserError(
                f"a plan of {actions.shape[0]} actions, and a symmetry of plans of "
                f"{form.places.shape[0]}: its `places` must permute the positions of the plan"
            )
        named = jnp.take_along_axis(form.names, actions[:, None] % num_actions, axis=1)[:, 0]
        return jnp.where(actions < num_actions, named, actions)[form.places]

    def conditional(
        params: Params, form: _Form, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, num_actions)
        if form.places is None or form.names is None:
            return energy.conditional(params, form.memory, actions, positions)
        there = jnp.argsort(form.places)[positions]
        energies = energy.conditional(params, form.memory, rename(form, actions), there)
        return jnp.take_along_axis(energies, form.names[positions], axis=1)

    def total(params: Params, form: _Form, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)
        return energy.total(params, form.memory, rename(form, actions))

    def violation(params: Params, form: _Form, actions: jax.Array) -> jax.Array:
        return energy.violation(params, form.memory, rename(form, actions))

    return energy._replace(
        encode=encode, conditional=conditional, total=total, turn=turn,
        violation=no_violation if energy.violation is no_violation else violation,
    )  # fmt: skip


def _check_turned(turned: Turned, num_actions: int) -> Turned:
    """Checks the shapes and types of what `draw` returned, see `symmetric`.

    Raises:
        UserError: they are others than `Turned` says.
    """
    horizon = np.size(check_kind(turned, Turned).places)
    for name, shape in ("places", (horizon,)), ("names", (horizon, num_actions)):
        given = getattr(turned, name)
        integers = jnp.issubdtype(getattr(given, "dtype", object), jnp.integer)
        if np.shape(given) != shape or not integers:
            raise UserError(
                f"{name} of a Turned must be integers of shape {list(shape)}, got "
                f"{getattr(given, 'dtype', given)}{list(np.shape(given))}"
            )
    return turned


def neutral(energy: Energy, actions: Sequence[int]) -> Energy:
    """Makes some actions of an energy neutral: each is as good as the best other action.

    Use it in `compose` if a model's data lack actions that another model needs: a model of going to
    objects should not object to picking them up. The model sees MASK in place of neutral actions.

    Args:
        energy: energy that accepts MASK.
        actions: neutral actions, as numbers or as booleans `[A]`; at least one action must remain.

    Raises:
        ValueError: the energy does not accept MASK or is constrained, or the actions are out of
            range, all actions, or an empty sequence.
    """
    chosen = check_indices("neutral actions", actions, check_kind(energy, Energy).num_actions)
    if energy.violation is not no_violation:
        raise ValueError("neutral comes before constrain: constrain what it returns")
    if not energy.accepts_mask:
        raise ValueError("neutral needs an energy that accepts MASK (accepts_mask is False)")
    if not chosen or len(chosen) >= energy.num_actions:
        raise ValueError(f"neutral actions {chosen}: expected some of {energy.num_actions} actions")
    unknown = np.isin(np.arange(energy.num_actions), chosen)
    mask = mask_token(energy.num_actions)

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        actions, positions = _check_query(actions, positions, energy.num_actions)
        masked = jnp.where(jnp.isin(actions, jnp.array(chosen)), mask, actions)
        energies = energy.conditional(params, memory, masked, positions)
        best = jnp.min(jnp.where(unknown, jnp.inf, energies), axis=-1, keepdims=True)
        return jnp.where(unknown, best, energies)

    total = _sum_of_conditionals(conditional, energy.num_actions)
    return energy._replace(conditional=conditional, total=total)


def _sum_of_conditionals(conditional: ConditionalFn, num_actions: int) -> TotalFn:
    """Makes a total from conditionals: the sum over positions of the energy of its action."""

    def total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        actions = _check_plan(actions, num_actions)

        def term(position: jax.Array) -> jax.Array:
            energies = conditional(params, memory, actions, position[None])[0]
            return energies[jnp.minimum(actions[position], num_actions - 1)]

        terms = jax.vmap(term)(jnp.arange(actions.shape[0]))
        return _infinite_if_incomplete(_check_total(jnp.sum(terms)), actions, num_actions)

    return total


def _try_every_action(
    evaluate: Callable[[jax.Array], jax.Array],
    actions: jax.Array,
    positions: jax.Array,
    num_actions: int,
) -> jax.Array:
    """Evaluates the plan with each action at each position in turn: `[P, A]`."""

    def at(position: jax.Array, action: jax.Array) -> jax.Array:
        return evaluate(actions.at[position].set(action))

    over_actions = jax.vmap(at, in_axes=(None, 0))
    choices = jnp.arange(num_actions, dtype=actions.dtype)
    return jax.vmap(over_actions, in_axes=(0, None))(positions, choices)


def _check_query(
    actions: jax.Array, positions: jax.Array, num_actions: int
) -> tuple[jax.Array, jax.Array]:
    """Checks actions and positions, and returns them as int32 arrays of JAX."""
    actions = _check_plan(actions, num_actions)
    end = actions.shape[0]
    expected = f"0 .. {end - 1}, the horizon is {end}"
    return actions, _check_integers("positions", positions, end, expected)


def _check_plan(actions: jax.Array, num_actions: int) -> jax.Array:
    """Checks actions `[T]`, which may be MASK, and returns them as an int32 array of JAX."""
    expected = f"0 .. {num_actions - 1}, or {num_actions} for MASK"
    return _check_integers("actions", actions, num_actions + 1, expected)


def _check_integers(name: str, values: jax.Array, end: int, expected: str) -> jax.Array:
    """Checks integers `[n]` below `end`, and returns them as an int32 array of JAX.

    Raises:
        ValueError: the values are not integers or, outside of `jit`, out of range.
    """
    if not isinstance(values, jax.Array):
        traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))
        # NumPy keeps 64 bits, which JAX would cut off.
        values = jnp.asarray(values) if traced else np.asarray(values)
        values = values if values.size else values.astype(np.int32)  # an empty list has no type
    if values.ndim != 1:
        raise UserError(f"{name} must be a sequence of integers, got shape {values.shape}")
    if not jnp.issubdtype(values.dtype, jnp.integer):
        raise ValueError(f"{name} must be integers, got {values.dtype}")
    if not isinstance(values, jax.core.Tracer) and values.size:
        concrete = np.asarray(values)  # also inside `jit`, if it is a constant
        if int(concrete.min()) < 0 or int(concrete.max()) >= end:
            raise ValueError(f"{name} {concrete} are not all in {expected}")
    return jnp.asarray(values, jnp.int32)


def _check_energies(energies: jax.Array, positions: jax.Array) -> jax.Array:
    if not isinstance(energies, jax.core.Tracer) and bool(jnp.isnan(energies).any()):
        rows = np.flatnonzero(np.isnan(energies).any(axis=-1))
        raise ValueError(
            f"the energies at positions {np.asarray(positions)[rows]} are NaN: the scores or "
            "penalties there are NaN, or the scores hold +inf or are all -inf"
        )
    return energies


def _check_total(energy: jax.Array) -> jax.Array:
    if not isinstance(energy, jax.core.Tracer) and bool(jnp.isnan(energy)):
        raise ValueError("the energy of the plan is NaN: look at the scores, totals or penalties")
    return energy


def _infinite_if_incomplete(energy: jax.Array, actions: jax.Array, num_actions: int) -> jax.Array:
    """Returns +inf for a plan that holds MASK, so that it is never the best plan."""
    complete = jnp.all((actions >= 0) & (actions < num_actions))
    return jnp.where(complete, energy, jnp.inf)
