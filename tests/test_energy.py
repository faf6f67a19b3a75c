import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.energy import (
    autoregressive,
    classifier,
    compose,
    constrain,
    from_total,
    neutral,
    pseudo_likelihood,
    single_action,
    view,
)
from leapjax.planners import GibbsConfig, bind
from leapjax.types import Energy, mask_token, pad_token
from tests.enumerable import (
    all_plans,
    conditional_by_counting,
    enumerable_energy,
    fit_p_value,
    joint_probabilities,
    random_table,
)
from tests.quick import quick_jit

HORIZON, ACTIONS = 3, 3
MASK = mask_token(ACTIONS)
EVERYWHERE = np.arange(HORIZON)
PLANS = all_plans(HORIZON, ACTIONS)
assert_close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
assert_equal = np.testing.assert_array_equal
NO_TILT = np.zeros((HORIZON, ACTIONS), np.float32)
ENUMERABLE = enumerable_energy(HORIZON, ACTIONS)
TABLE, OTHER_TABLE = random_table(0, HORIZON, ACTIONS), random_table(1, HORIZON, ACTIONS)


@functools.cache
def make_evaluator(energy):
    """Makes a function that evaluates an energy for many plans, compiled once."""

    def measure(params, memory, plan):
        return (
            jax.vmap(lambda t: energy.conditional(params, memory, plan, t[None])[0])(EVERYWHERE),
            energy.total(params, memory, plan),
            energy.violation(params, memory, plan),
        )

    @quick_jit
    def evaluate_plans(params, context, plans):
        return jax.vmap(measure, (None, None, 0))(params, energy.encode(params, context), plans)

    return evaluate_plans


class Evaluation(NamedTuple):
    """Energies and violations of many plans."""

    conditional: np.ndarray  # [plans, T, A]: each action at each position
    total: np.ndarray
    violation: np.ndarray


def evaluate(energy, params=TABLE, context=NO_TILT, plans=PLANS):
    # All calls have one shape, so that an energy is compiled once: plans are repeated to fill it.
    rows = np.resize(plans, (len(PLANS), HORIZON)).astype(np.int32)
    results = make_evaluator(energy)(params, context, rows)
    return Evaluation(*(np.array(result)[: len(plans)] for result in results))


def probabilities(energies):
    """Returns the probabilities of actions at temperature 1, in float64."""
    weights = np.exp(-(energies - energies.min(-1, keepdims=True)).astype(np.float64))
    return weights / weights.sum(-1, keepdims=True)


def exact_conditionals(joint, plans=PLANS):
    return np.array(
        [[conditional_by_counting(joint, plan, t) for t in range(HORIZON)] for plan in plans]
    )


# The enumerable energy, which later tests use as a reference.


def test_enumerable_energy_equals_the_joint():
    tilt = np.random.default_rng(5).normal(size=(HORIZON, ACTIONS)).astype(np.float32)
    joint = joint_probabilities(TABLE, tilt)
    assert_close(evaluate(ENUMERABLE, context=tilt).total, -np.log(joint.reshape(-1)))
    masked = np.array([[MASK, MASK, MASK], [2, MASK, 0], [MASK, 1, MASK], [0, 2, MASK]], np.int32)
    plans = np.concatenate([masked, PLANS[::5]])
    found = evaluate(ENUMERABLE, context=tilt, plans=plans)
    assert_close(probabilities(found.conditional), exact_conditionals(joint, plans))
    assert np.isposinf(found.total[:4]).all()


# The pseudo-likelihood of a masked language model.


def pairwise_logits(params, memory, tokens, positions):
    """Sums the votes of all tokens for the action at a position; `params` is `[T, T, A + 2, A]`."""
    votes = params[positions[:, None], jnp.arange(HORIZON), tokens] + memory
    return votes.sum(1)


PAIRWISE = pseudo_likelihood(lambda params, context: context["bias"], pairwise_logits, ACTIONS)
VOTES = np.random.default_rng(2).normal(size=(HORIZON, HORIZON, ACTIONS + 2, ACTIONS))
VOTES = VOTES.astype(np.float32)
BIAS = {"bias": np.random.default_rng(3).normal(size=ACTIONS).astype(np.float32)}


def pairwise_log_likelihood(tokens, position):
    logits = sum(VOTES[position, t, tokens[t]] + BIAS["bias"] for t in range(HORIZON))
    logits = logits.astype(np.float64)
    return logits - np.log(np.exp(logits).sum())


def test_pseudo_likelihood_total_equals_a_loop_over_positions():
    expected = np.zeros(len(PLANS))
    for row, t in np.ndindex(len(PLANS), HORIZON):
        masked = np.where(t == EVERYWHERE, MASK, PLANS[row])
        expected[row] -= pairwise_log_likelihood(masked, t)[PLANS[row, t]]
    assert_close(evaluate(PAIRWISE, VOTES, BIAS).total, expected)


def test_autoregressive_energy_factorises_the_joint():
    """Its total is the negative log-likelihood; its conditionals depend on earlier actions only."""

    def logits(params, memory, tokens, positions):
        def at(position):
            before = jnp.where(position > EVERYWHERE, tokens, MASK)
            return -ENUMERABLE.conditional(params, memory, before, position[None])[0]

        return jax.vmap(at)(positions) + 5.0  # up to a constant

    energy = autoregressive(ENUMERABLE.encode, logits, ACTIONS)
    joint = joint_probabilities(TABLE)
    found, sums, _ = evaluate(energy)
    assert_close(sums, -np.log(joint.reshape(-1)))
    for plan, energies in zip(PLANS, found, strict=True):
        before = [np.where(t > EVERYWHERE, plan, MASK) for t in range(HORIZON)]
        expected = [-np.log(conditional_by_counting(joint, before[t], t)) for t in range(HORIZON)]
        np.testing.assert_allclose(energies, expected, rtol=1e-3, atol=1e-4)
    assert np.isposinf(evaluate(energy, plans=np.array([[0, 1, MASK]])).total).all()


@pytest.mark.parametrize("energy", [PAIRWISE, from_total(PAIRWISE.encode, PAIRWISE.total, ACTIONS)])
def test_incomplete_plan_has_infinite_total(energy):
    incomplete = [[t if s != t else token for s in range(3)] for t in range(3) for token in (3, 4)]
    incomplete += [[MASK] * 3, [pad_token(ACTIONS)] * 3, [0, -1, 0]]
    assert np.isposinf(
        evaluate(energy, VOTES, BIAS, plans=np.array(incomplete, np.int32)).total
    ).all()
    assert np.isfinite(evaluate(energy, VOTES, BIAS).total).all()


def test_forbidden_actions_have_infinite_energy_and_not_nan():
    def logits(params, memory, tokens, positions):
        forbidden = (positions[:, None] == 1) & (jnp.arange(ACTIONS) == 2)
        return jnp.where(forbidden, -jnp.inf, pairwise_logits(params, memory, tokens, positions))

    found = evaluate(pseudo_likelihood(PAIRWISE.encode, logits, ACTIONS), VOTES, BIAS)
    assert_equal(np.isposinf(found.total), PLANS[:, 1] == 2)
    assert np.isposinf(found.conditional[:, 1, 2]).all()
    # The other actions still have a distribution.
    assert_close(np.exp(-found.conditional).sum(-1), np.ones(PLANS.shape))


def test_from_total_accepts_integer_totals():
    energy = from_total(lambda p, c: None, lambda p, m, actions: jnp.sum(actions == 1), ACTIONS)
    assert energy.total(None, None, np.array([1, 0, 1])).dtype == jnp.float32
    assert_equal(
        energy.conditional(None, None, np.array([1, 0, 1]), np.array([1, 2])),
        [[2, 3, 2], [1, 2, 1]],
    )


# Sums of energies.


@pytest.mark.parametrize("weights", [None, (0.5, 2.0)])
def test_compose_multiplies_the_joints_with_weights(weights):
    first, second = weights or (1.0, 1.0)
    found = evaluate(compose([ENUMERABLE, ENUMERABLE], weights), (TABLE, OTHER_TABLE))
    logs = [np.log(joint_probabilities(table)) for table in (TABLE, OTHER_TABLE)]
    product = np.exp(first * logs[0] + second * logs[1])
    assert_close(found.total, -np.log(product.reshape(-1)))
    assert_close(probabilities(found.conditional), exact_conditionals(product / product.sum()))


ZERO = Energy(
    lambda params, context: None,
    lambda params, memory, actions, positions: jnp.zeros((positions.shape[0], ACTIONS)),
    lambda params, memory, actions: jnp.zeros(()),
    ACTIONS,
)
# Multiplying this energy by 0, instead of leaving it out, gives NaN.
INFINITE = Energy(
    lambda params, context: None,
    lambda params, memory, actions, positions: jnp.full((positions.shape[0], ACTIONS), jnp.inf),
    lambda params, memory, actions: jnp.float32(jnp.inf),
    ACTIONS,
    accepts_mask=False,
    violation=lambda params, memory, actions: jnp.ones(()),
)


@pytest.mark.parametrize(
    ("other", "weights"), [(ZERO, None), (INFINITE, (1.0, 0.0)), (INFINITE, (1.0, 1e-39))]
)
def test_compose_ignores_zero_energies_and_zero_weights(other, weights):
    composed = compose([ENUMERABLE, other], weights)
    found, expected = evaluate(composed, (TABLE, OTHER_TABLE)), evaluate(ENUMERABLE)
    assert_equal(found.conditional, expected.conditional)
    assert_equal(found.total, expected.total)
    # A constraint counts at every weight of its energy, also at 0.
    assert (found.violation == (other is INFINITE)).all()
    assert composed.accepts_mask and not compose([ENUMERABLE, INFINITE]).accepts_mask


FORBIDDING = constrain(ENUMERABLE, lambda context, actions: 1.0 * (actions[0] == 1))
DERIVED = {
    "weight 0": (compose([ENUMERABLE, FORBIDDING], [1, 0]), (TABLE, TABLE)),
    "nested": (
        compose([ENUMERABLE, compose([FORBIDDING, ENUMERABLE], [0, 1])], [1, 0]),
        (TABLE, (TABLE, TABLE)),
    ),
    "seen through a view": (view(FORBIDDING, lambda context: context), TABLE),
    "of a constrained neutral": (
        compose([constrain(neutral(ENUMERABLE, [2]), lambda c, a: 1.0 * (a[0] == 1))], [0]),
        (TABLE,),
    ),
}


@pytest.mark.parametrize("case", DERIVED)
def test_every_operation_keeps_constraints(case):
    energy, params = DERIVED[case]
    memory = energy.encode(params, NO_TILT)
    for plan in ([1, 0, 2], [0, 1, 2]):
        assert energy.violation(params, memory, np.array(plan)) == (plan[0] == 1)
    with pytest.raises(ValueError, match="neutral comes before constrain"):
        neutral(energy, [2])


# Constraints and views.


def penalise_repeats(context, actions):
    """Penalises a plan by `context["price"]` for each repeated action."""
    count = jnp.sum(actions[1:] == actions[:-1])
    return jnp.where(count > 0, context["price"] * jnp.maximum(count, 1), 0.0)


def count_repeats(plan):
    return sum(a == b for a, b in zip(plan[1:], plan[:-1], strict=True))


CONSTRAINED = constrain(view(ENUMERABLE, lambda context: context["tilt"]), penalise_repeats)


@pytest.mark.parametrize("price", [2.5, np.inf])
def test_constraint_adds_the_penalty_of_the_changed_plan(price):
    context = {"tilt": NO_TILT, "price": np.float32(price)}
    # The reference: a loop over the penalties of each action at each position of each plan.
    added = np.zeros((len(PLANS), HORIZON, ACTIONS))
    for row, t, action in np.ndindex(added.shape):
        count = count_repeats(np.where(t == EVERYWHERE, action, PLANS[row]))
        added[row, t, action] = count * price if count else 0
    # A position ignores the penalty if it forbids all actions there: another position must change.
    hopeless = np.isinf(added).all(-1, keepdims=True)
    assert hopeless.any() == np.isinf(price)
    found, free = evaluate(CONSTRAINED, context=context), evaluate(ENUMERABLE)
    assert_close(found.conditional, free.conditional + np.where(hopeless, 0, added))
    penalties = np.array([count_repeats(p) * price if count_repeats(p) else 0 for p in PLANS])
    assert_close(found.total, free.total + penalties)
    assert_equal(found.violation > 0, penalties > 0)


def test_constraint_applies_to_complete_plans_only():
    context = {"tilt": NO_TILT, "price": np.float32(np.inf)}
    plans = np.array([[MASK, MASK, MASK], [0, 1, MASK], [0, MASK, MASK]], np.int32)
    constrained = evaluate(CONSTRAINED, context=context, plans=plans).conditional
    expected = evaluate(ENUMERABLE, plans=plans).conditional
    expected[1, 2, 1] = np.inf  # the only action that completes a plan with a repeat
    assert_equal(constrained, expected)


def test_partial_penalty_applies_to_incomplete_plans():
    def penalise_first_zero(context, actions):  # depends on the first action only
        return jnp.where(actions[0] == 0, 50.0, 0.0)

    complete_only, any_plan = (
        constrain(ENUMERABLE, penalise_first_zero, partial=partial) for partial in (False, True)
    )
    blank = np.full((1, HORIZON), MASK, np.int32)
    free = evaluate(ENUMERABLE, plans=blank).conditional
    assert_equal(evaluate(complete_only, plans=blank).conditional, free)
    found = evaluate(any_plan, plans=blank).conditional[0, 0]
    np.testing.assert_allclose(found - free[0, 0], [50, 0, 0], rtol=1e-4)
    assert_equal(evaluate(any_plan).conditional, evaluate(complete_only).conditional)


def test_neutral_actions_equal_the_best_other_action_and_read_as_mask():
    expected = evaluate(ENUMERABLE, plans=np.where(PLANS == 2, MASK, PLANS)).conditional
    expected[..., 2] = expected[..., :2].min(axis=-1)
    found = evaluate(neutral(ENUMERABLE, [2]))
    assert_close(found.conditional, expected)
    assert_close(found.total, np.take_along_axis(expected, PLANS[..., None], -1).sum((1, 2)))


def test_negative_penalty_does_not_offset_violations():
    first = PLANS[:, 0] == 2
    rewarded = constrain(CONSTRAINED, lambda context, actions: -5.0 * (actions[0] == 2))
    context = {"tilt": NO_TILT, "price": np.float32(1.0)}
    found, without = (evaluate(energy, context=context) for energy in (rewarded, CONSTRAINED))
    assert_equal(found.violation, without.violation)
    assert (found.violation[first] > 0).any()
    assert_close(found.total, without.total - 5 * first)


# Energies of methods that choose one action at a time.


CHOICES = 5  # and the end action
SCORES = np.array([0.3, -1.0, 1.2, -np.inf, 0.9], np.float32)
SINGLE = single_action(
    lambda params, context: context, lambda params, memory: params + memory, CHOICES + 1
)


def test_single_action_at_temperature_one_samples_the_policy():
    shift = np.linspace(-0.5, 0.5, CHOICES, dtype=np.float32)
    planner = bind(SINGLE, GibbsConfig(1, 1, temperature=1.0, score=True))
    keys = jax.random.split(jax.random.key(0), 5000)
    plan = quick_jit(jax.vmap(planner, (None, 0, None)))(SCORES, keys, shift)
    assert plan.actions.shape == (5000, 1) and plan.valid.all()
    [actions] = np.asarray(plan.actions).T
    weights = np.exp([*(SCORES + shift), -np.inf])  # the end action has probability 0
    counts = np.bincount(actions, minlength=CHOICES + 1)
    assert fit_p_value(counts, weights / weights.sum()) > 1e-3
    np.testing.assert_allclose(plan.energy, -(SCORES + shift)[actions], rtol=1e-6)


def test_single_action_total_is_the_negative_score():
    memory = SINGLE.encode(SCORES, np.float32(0))
    found = [SINGLE.total(SCORES, memory, jnp.array([action])) for action in range(CHOICES + 2)]
    assert_equal(found, [*-SCORES, np.inf, np.inf])  # the end action and MASK


# Invalid arguments, and constraints that cannot be met.


def from_scores(scores):
    """Makes an energy from fixed scores `[T, A]`, which ignores the context."""
    return pseudo_likelihood(
        lambda params, context: None,
        lambda params, memory, tokens, positions: jnp.asarray(scores)[positions],
        ACTIONS,
    )


def test_constraint_is_ignored_if_it_allows_only_forbidden_actions():
    """The conditional keeps the model's best action, and the plan counts as a violation."""
    free = from_scores(np.tile([3.0, -np.inf, 1.0], (HORIZON, 1)).astype(np.float32))
    restricted = constrain(free, lambda context, plan: jnp.where(plan[0] == 1, 0.0, jnp.inf))
    start, first = jnp.zeros(HORIZON, jnp.int32), jnp.array([0])
    found = restricted.conditional(None, (None, None), start, first)
    assert_equal(found, free.conditional(None, None, start, first))
    assert restricted.violation(None, (None, None), start) > 0


FROM_TOTAL = from_total(PAIRWISE.encode, PAIRWISE.total, ACTIONS)
FREE = from_scores(np.zeros((HORIZON, ACTIONS), np.float32))
START = jnp.zeros(HORIZON, jnp.int32)


def violation_of(penalty):
    energy = constrain(FREE, lambda context, actions: penalty)
    return energy.violation(None, (None, None), START)


def conditional_of(energy, actions=START, positions=(0, 1), params=VOTES, memory=BIAS["bias"]):
    return energy.conditional(params, memory, actions, jnp.array(positions))


def conditional_of_scores(row):
    scores = np.zeros((HORIZON, ACTIONS), np.float32)
    scores[1] = row
    return conditional_of(from_scores(scores), positions=(2, 1))


def total_of(total):
    return from_total(lambda p, c: None, lambda p, m, a: total, ACTIONS).total(None, None, START)


MISTAKES = [
    *(
        (lambda w=weight: compose([ENUMERABLE, ENUMERABLE], [1.0, w]), "weights must be")
        for weight in (-1.0, float("nan"))
    ),
    (lambda: compose([ENUMERABLE, ENUMERABLE], [1.0]), "2 energies need as many weights"),
    (lambda: compose([], []), "at least one energy"),
    (lambda: compose([FREE, enumerable_energy(3, 4)]), r"one action set, got sizes \[3, 4\]"),
    (lambda: compose(FREE), "a sequence of energies, got one energy"),
    (lambda: compose([FREE, None]), "expected Energy, got"),
    (lambda: compose([FREE, FREE]).encode((None,), None), "params of 2 composed energies"),
    (lambda: neutral(FROM_TOTAL, [0]), "accepts MASK"),
    (lambda: neutral(ENUMERABLE, [0, 1, 2]), "expected some of 3 actions"),
    (lambda: neutral(ENUMERABLE, [3]), "neutral actions must be at most 2"),
    (lambda: total_of(jnp.zeros(3)), r"must be one number, got shape \(3,\)"),
    (lambda: total_of(jnp.float32(jnp.nan)), "energy of the plan is NaN"),
    (lambda: conditional_of_scores([np.nan, 0, 0]), r"energies at positions \[1\] are NaN"),
    (lambda: conditional_of(from_scores(np.zeros((3, 2)))), r"logits must be of shape \(2, 3\)"),
    (lambda: violation_of(None), "a penalty must be"),
    (lambda: conditional_of(FREE, positions=[-1]), r"positions .* are not all in 0 \.\. 2"),
    (lambda: conditional_of(FROM_TOTAL, positions=[0, 3]), r"positions .* are not all in 0 \.\. 2"),
    *(
        (
            lambda e=e, a=a: conditional_of(e, START.at[1].set(a)),
            r"not all in 0 \.\. 2, or 3 for MASK",
        )
        for e in (FREE, FROM_TOTAL)
        for a in (-1, ACTIONS + 1)
    ),
    (lambda: FREE.total(None, None, [[0]]), "must be a sequence of integers"),
    (lambda: SINGLE.total(SCORES, np.float32(0), START), "its horizon is 1"),
    (
        lambda: single_action(lambda *_: (), lambda p, m: jnp.zeros(3), 3).total(None, (), [0]),
        r"scores must be of shape \(2,\), got shape \(3,\)",
    ),
    *(
        (lambda m=make: m(None, None, 0), "num_actions must be")
        for make in (pseudo_likelihood, autoregressive, from_total, single_action, classifier)
    ),
    (lambda: mask_token(2**31 - 1), "num_actions must be"),
]


@pytest.mark.parametrize(("call", "message"), MISTAKES)
def test_mistakes_raise_an_error(call, message):
    with pytest.raises(ValueError, match=message):
        call()


OPERATIONS = {  # by name: an energy and its memory
    "pseudo_likelihood": (FREE, ()),
    "autoregressive": (autoregressive(lambda p, c: (), FREE.conditional, ACTIONS), ()),
    "from_total": (from_total(lambda p, c: (), lambda p, m, a: 0.0, ACTIONS), ()),
    "compose": (compose([FREE, FREE], [0, 0]), ((), ())),
    "constrain": (constrain(FREE, lambda context, actions: jnp.float32(0)), ((), ())),
    "neutral": (neutral(FREE, [2]), ()),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_actions_and_positions_must_be_integers_also_while_traced(name):
    energy, memory = OPERATIONS[name]

    def evaluate(actions=START, positions=EVERYWHERE):
        energy.total(memory, memory, actions)
        return energy.conditional(memory, memory, actions, positions)

    assert evaluate().shape == (HORIZON, ACTIONS)
    for wrong in (np.zeros(HORIZON), np.zeros(HORIZON, bool), ["0", "1"], np.array([2**32] * 3)):
        for part in ("actions", "positions"):
            with pytest.raises(ValueError, match=part):
                evaluate(**{part: wrong})
    for kind in (jnp.float32, bool):
        for part in ("actions", "positions"):
            with pytest.raises(ValueError, match="must be integers"):
                jax.eval_shape(evaluate, **{part: jax.ShapeDtypeStruct((3,), kind)})


def test_small_integer_types_are_widened_to_hold_mask():
    """With 256 actions, MASK is 256 and does not fit into eight bits."""

    def logits(params, memory, tokens, positions):
        assert tokens.tolist() == [256, 0]
        return jnp.zeros((len(positions), 256))

    energy = pseudo_likelihood(lambda p, c: (), logits, 256)
    energy.conditional((), (), np.array([255, 0], np.uint8), np.array([0], np.int8))


@pytest.mark.parametrize("kind", [np.uint32, bool, jnp.bfloat16])
def test_single_action_accepts_scores_of_any_real_type(kind):
    scores = jnp.array([1, 0], kind)  # an unsigned -1 would be 2^32 - 1
    energy = single_action(lambda params, context: (), lambda p, m: scores, 3)
    energies = energy.conditional(None, (), jnp.zeros(1, jnp.int32), jnp.zeros(1, jnp.int32))
    assert_equal(energies, [[-1, 0, np.inf]])
