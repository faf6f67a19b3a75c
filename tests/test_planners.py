import functools
import itertools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from leapjax.batching import NotANumber, check_fit, compile_planner, plan_keys, split_batch
from leapjax.energy import compose, constrain, from_total, view
from leapjax.errors import UserError
from leapjax.planners import (
    FILLS,
    ORDERS,
    BeamConfig,
    CrossEntropyConfig,
    GibbsConfig,
    ShootingConfig,
    bind,
)
from leapjax.types import Energy
from tests.enumerable import (
    all_plans,
    conditional_by_counting,
    enumerable_energy,
    fit_p_value,
    joint_probabilities,
    no_tilt,
    plan_counts,
    random_table,
    total_variation,
)
from tests.programs import only_long
from tests.quick import quick_jit

HORIZON, ACTIONS = 3, 3
PLANS = all_plans(HORIZON, ACTIONS)
NO_TILT = no_tilt(HORIZON, ACTIONS)
ENUMERABLE = enumerable_energy(HORIZON, ACTIONS)
FROM_TOTAL = from_total(ENUMERABLE.encode, ENUMERABLE.total, ACTIONS)
TABLE = random_table(0, HORIZON, ACTIONS)
JOINT = joint_probabilities(TABLE)
CHAINS = 5000
REJECTED, ACCEPTED = 1e-9, 1e-3  # p-values: a sampler that is wrong, one that may be right


@functools.cache
def many_plans(energy, config):
    """The planner for a batch of keys in one context, compiled once."""
    planner = bind(energy, config)

    def plan(params, keys, context):
        return jax.vmap(lambda key: planner(params, key, context))(keys)

    return quick_jit(plan)


def plans_of(energy, config, params=TABLE, context=NO_TILT, chains=CHAINS, seed=0):
    keys = jax.random.split(jax.random.key(seed), chains)
    return jax.tree.map(np.asarray, many_plans(energy, config)(params, keys, context))


def joint_energies(plans, joint=JOINT):
    """The exact negative log joint of plans `[..., T]`."""
    return -np.log(joint[tuple(np.moveaxis(np.asarray(plans), -1, 0))])


# Gibbs sampling against the exact joint.


@pytest.mark.parametrize(
    ("energy", "order"),
    [(ENUMERABLE, "random"), (ENUMERABLE, "sequential"), (FROM_TOTAL, "random")],
)
def test_gibbs_at_temperature_one_samples_the_joint(energy, order):
    config = GibbsConfig(HORIZON, iterations=50, temperature=1.0, order=order)
    counts = plan_counts(plans_of(energy, config).actions, ACTIONS)
    assert fit_p_value(counts, JOINT) > ACCEPTED
    assert total_variation(counts, JOINT) < 0.04


def test_temperature_sharpens_the_joint():
    config = GibbsConfig(HORIZON, iterations=50, temperature=0.5)
    counts = plan_counts(plans_of(ENUMERABLE, config).actions, ACTIONS)
    sharper = joint_probabilities(2 * TABLE.astype(np.float64))
    assert fit_p_value(counts, sharper) > ACCEPTED


def _blind_to_other_actions(params, memory, actions, positions):
    masked = jnp.full_like(actions, ACTIONS)
    return ENUMERABLE.conditional(params, memory, masked, positions)


@pytest.mark.parametrize(
    ("energy", "temperature"),
    [
        (ENUMERABLE, 0.5),
        (ENUMERABLE, 1.25),
        (ENUMERABLE._replace(conditional=_blind_to_other_actions), 1.0),
    ],
    ids=["cold", "warm", "blind"],
)
def test_a_broken_sampler_does_not_pass_for_the_joint(energy, temperature):
    config = GibbsConfig(HORIZON, iterations=50, temperature=temperature)
    counts = plan_counts(plans_of(energy, config).actions, ACTIONS)
    assert fit_p_value(counts, JOINT) < REJECTED
    assert total_variation(counts, JOINT) > 0.06


def test_composed_energies_sample_the_product_of_the_joints():
    other = random_table(1, HORIZON, ACTIONS)
    weights = (0.7, 1.5)
    config = GibbsConfig(HORIZON, iterations=60, temperature=1.0)
    composed = compose([ENUMERABLE, ENUMERABLE], weights)
    counts = plan_counts(plans_of(composed, config, (TABLE, other)).actions, ACTIONS)
    logs = weights[0] * TABLE.astype(np.float64) + weights[1] * other
    assert fit_p_value(counts, joint_probabilities(logs)) > ACCEPTED
    assert fit_p_value(counts, JOINT) < REJECTED


def test_first_draw_follows_the_marginals_independently():
    plan = plans_of(ENUMERABLE, GibbsConfig(HORIZON, iterations=50, temperature=1.0))
    blank = np.full(HORIZON, ACTIONS)
    marginals = [conditional_by_counting(JOINT, blank, t) for t in range(HORIZON)]
    for t, marginal in enumerate(marginals):
        draws = np.bincount(plan.trace[:, 0, t], minlength=ACTIONS)
        assert fit_p_value(draws, marginal) > ACCEPTED
    counts = plan_counts(plan.trace[:, 0], ACTIONS)
    assert fit_p_value(counts, np.einsum("a,b,c->abc", *marginals)) > ACCEPTED
    # No iteration has joined the positions yet.
    assert fit_p_value(counts, JOINT) < REJECTED


def test_without_mask_the_first_plan_is_uniform():
    plan = plans_of(FROM_TOTAL, GibbsConfig(HORIZON, iterations=50, temperature=1.0))
    uniform = np.full(len(PLANS), 1 / len(PLANS))
    assert fit_p_value(plan_counts(plan.trace[:, 0], ACTIONS), uniform) > ACCEPTED


@pytest.mark.parametrize("iterations", [1, 2])
def test_without_mask_no_plan_begins_with_what_cannot_come_first(iterations):
    """As an end action cannot: with it every plan is as bad, so none of them would be left."""

    def total(params, memory, actions):
        energy = ENUMERABLE.total(params, memory, actions)
        return jnp.where(actions[0] == ACTIONS - 1, jnp.inf, energy)

    guarded = from_total(ENUMERABLE.encode, total, ACTIONS)
    plan = plans_of(guarded, GibbsConfig(HORIZON, iterations, temperature=1.0, score=True))
    assert np.isfinite(plan.energy).all() and plan.valid.all()
    counts = plan_counts(plan.trace[:, 0], ACTIONS)
    assert fit_p_value(counts, (PLANS[:, 0] != ACTIONS - 1) / 18) > ACCEPTED


@functools.cache
def greedy_traces(order, fill="together"):
    """Traces `[tables, N, T]` at temperature 0, each on a joint of its own, and the joints."""
    tables = np.stack([random_table(seed, HORIZON, ACTIONS) for seed in range(200)])
    config = GibbsConfig(HORIZON, iterations=16, order=order, fill=fill)
    keys = jax.random.split(jax.random.key(1), len(tables))
    plan = quick_jit(jax.vmap(lambda p, k: bind(ENUMERABLE, config)(p, k, NO_TILT)))(tables, keys)
    return np.asarray(plan.trace), [joint_probabilities(table) for table in tables]


@pytest.mark.parametrize("order", ORDERS)
def test_greedy_gibbs_never_raises_the_joint_energy(order):
    traces, joints = greedy_traces(order)
    changes = np.array([np.diff(joint_energies(t, j)) for t, j in zip(traces, joints, strict=True)])
    assert (changes <= 1e-5).all()
    assert (changes < -0.1).sum() > 50


def test_greedy_sweeps_end_where_no_single_action_helps():
    traces, joints = greedy_traces("sequential")
    for trace, joint in zip(traces, joints, strict=True):
        for t in range(HORIZON):
            conditional = conditional_by_counting(joint, trace[-1], t)
            assert conditional[trace[-1][t]] == pytest.approx(conditional.max(), rel=1e-5)


def test_greedy_start_takes_the_most_likely_action_everywhere():
    traces, joints = greedy_traces("random")
    blank = np.full(HORIZON, ACTIONS)
    for trace, joint in zip(traces, joints, strict=True):
        for t in range(HORIZON):
            marginal = conditional_by_counting(joint, blank, t)
            assert marginal[trace[0][t]] == pytest.approx(marginal.max(), rel=1e-5)


# Filling a plan position by position.

ONE_BY_ONE = [fill for fill in FILLS if fill != "together"]


@pytest.mark.parametrize("fill", ONE_BY_ONE)
def test_filling_one_by_one_at_temperature_one_samples_the_joint(fill):
    config = GibbsConfig(HORIZON, iterations=HORIZON, fill=fill, temperature=1.0)
    counts = plan_counts(plans_of(ENUMERABLE, config).actions, ACTIONS)
    assert fit_p_value(counts, JOINT) > ACCEPTED
    assert total_variation(counts, JOINT) < 0.04


def test_filling_two_at_once_is_not_the_joint():
    config = GibbsConfig(HORIZON, iterations=2, fill="random", resampled=2, temperature=1.0)
    counts = plan_counts(plans_of(ENUMERABLE, config).actions, ACTIONS)
    assert fit_p_value(counts, JOINT) < REJECTED


@pytest.mark.parametrize("fill", ONE_BY_ONE)
@pytest.mark.parametrize(("resampled", "chosen"), [(1, [1, 2, 3]), (2, [2, 3]), (3, [3])])
def test_each_pass_fills_so_many_and_keeps_them(fill, resampled, chosen):
    config = GibbsConfig(
        HORIZON, iterations=len(chosen), fill=fill, resampled=resampled, temperature=1.0
    )
    trace = plans_of(ENUMERABLE, config, chains=200).trace
    known = trace < ACTIONS  # [chains, N, T]
    assert (known.sum(-1) == chosen).all()
    for before, after in itertools.pairwise(range(len(chosen))):
        kept = (trace[:, before] == trace[:, after]) | ~known[:, before]
        assert kept.all()
    if fill == "sequential":
        np.testing.assert_array_equal(known[0], np.arange(HORIZON) < np.array(chosen)[:, None])


@pytest.mark.parametrize("fill", ["confident", "margin"])
def test_the_most_certain_position_is_filled_first(fill):
    tables = np.stack([random_table(seed, HORIZON, ACTIONS) for seed in range(100)])
    config = GibbsConfig(HORIZON, iterations=HORIZON, fill=fill)
    plan = quick_jit(
        jax.vmap(lambda params: bind(ENUMERABLE, config)(params, jax.random.key(0), NO_TILT))
    )
    firsts = set()
    for table, trace in zip(tables, np.asarray(plan(tables).trace), strict=True):
        joint, tokens = joint_probabilities(table), np.full(HORIZON, ACTIONS)
        for step, after in enumerate(trace):
            certainty = np.full(HORIZON, -np.inf)
            for t in np.flatnonzero(tokens == ACTIONS):
                second, likeliest = np.sort(conditional_by_counting(joint, tokens, t))[-2:]
                certainty[t] = likeliest if fill == "confident" else likeliest - second
            (chosen,) = np.flatnonzero(after != tokens)
            assert certainty[chosen] == pytest.approx(certainty.max(), rel=1e-4)
            conditional = conditional_by_counting(joint, tokens, chosen)
            assert conditional[after[chosen]] == pytest.approx(conditional.max(), rel=1e-4)
            firsts |= {chosen} if step == 0 else set()
            tokens = after
    assert len(firsts) == HORIZON


@pytest.mark.parametrize("order", ORDERS)
def test_what_follows_a_filled_plan_is_gibbs_sampling(order):
    traces, joints = greedy_traces(order, "random")
    assert (traces[:, HORIZON - 2] == ACTIONS).any(axis=-1).all()
    filled = traces[:, HORIZON - 1 :]
    changes = np.array([np.diff(joint_energies(t, j)) for t, j in zip(filled, joints, strict=True)])
    assert (changes <= 1e-5).all()
    assert (changes < -0.1).sum() > 3


def test_a_constraint_is_obeyed_once_a_plan_is_complete():
    def penalty(context, actions):
        return 100.0 * (actions[0] == actions[1])

    table = np.zeros((ACTIONS,) * HORIZON, np.float32)
    table[0, 0] = 3.0  # against the constraint
    constrained = constrain(ENUMERABLE, penalty)
    fills = GibbsConfig(HORIZON, iterations=HORIZON, fill="confident")
    refines = GibbsConfig(HORIZON, iterations=2 * HORIZON, fill="confident", order="sequential")
    assert not plans_of(constrained, fills, table, chains=20).satisfied.any()
    assert plans_of(constrained, refines, table, chains=20).satisfied.all()


def test_an_energy_of_complete_plans_cannot_be_filled():
    with pytest.raises(ValueError, match="fill 'confident' .* use fill 'together'"):
        plans_of(FROM_TOTAL, GibbsConfig(HORIZON, fill="confident"), chains=2)


# Which positions are resampled.


def _next_action(params, memory, actions, positions):
    wanted = (actions[positions] + 1) % 5
    return jnp.where(jnp.arange(5) == wanted[:, None], 0.0, 1.0)


# Every resampled action goes up by one, so the trace tells which positions were resampled.
COUNTER = Energy(lambda params, context: None, _next_action, lambda *_: jnp.zeros(()), 5)


def resampled_positions(config, chains=1500):
    trace = plans_of(COUNTER, config, None, None, chains).trace
    steps = np.diff(trace, axis=1) % 5
    assert np.isin(steps, (0, 1)).all()
    return steps.astype(bool)  # [chains, N - 1, T]


@pytest.mark.parametrize("resampled", [1, 2, 3])
def test_random_order_is_uniform_over_sets_of_distinct_positions(resampled):
    changed = resampled_positions(GibbsConfig(4, iterations=4, resampled=resampled))
    assert (changed.sum(-1) == resampled).all()
    sets = changed.reshape(-1, 4) @ (2 ** np.arange(4))
    possible = np.array([bin(i).count("1") == resampled for i in range(16)])
    counts = np.bincount(sets, minlength=16)
    assert fit_p_value(counts, possible / possible.sum()) > ACCEPTED
    # Iterations choose independently.
    expected = possible.sum() ** -1.0
    again = np.mean((changed[:, 0] == changed[:, 1]).all(-1))
    assert again == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(
    ("resampled", "expected"),
    [(1, [[0], [1], [2], [3], [0], [1]]), (3, [[0, 1, 2], [3, 0, 1], [2, 3, 0], [1, 2, 3]])],
)
def test_sequential_order_goes_from_left_to_right_and_around(resampled, expected):
    iterations = len(expected) + 1
    config = GibbsConfig(4, iterations=iterations, resampled=resampled, order="sequential")
    changed = resampled_positions(config, chains=2)
    for row in changed:
        assert [set(np.flatnonzero(step)) for step in row] == [set(step) for step in expected]


CERTAINTY = np.array([2.0, 0.5, 3.0, 1.0], np.float32)  # of the positions of `_next_sure_action`


def _next_sure_action(params, memory, actions, positions):
    """As `_next_action`, surer of some positions than of others."""
    return (
        _next_action(params, memory, actions, positions) * jnp.array(CERTAINTY)[positions][:, None]
    )


@pytest.mark.parametrize(
    ("resampled", "expected"), [(1, [1, 3, 0, 2, 1, 3]), (2, [(1, 3), (0, 2), (1, 3)])]
)
def test_uncertain_order_resamples_the_least_certain_and_all_before_any_again(resampled, expected):
    energy = COUNTER._replace(conditional=_next_sure_action)
    config = GibbsConfig(4, 1 + len(expected), resampled, order="uncertain")
    trace = plans_of(energy, config, None, None, 2).trace
    for row in np.diff(trace, axis=1) % 5:
        found = [tuple(np.flatnonzero(step)) for step in row]
        assert found == [tuple(np.ravel(where)) for where in expected]


def test_positions_resampled_together_are_masked_together():
    # All three at once, from all MASK: every iteration is again a draw of the marginals.
    config = GibbsConfig(HORIZON, iterations=3, resampled=HORIZON, temperature=1.0)
    trace = plans_of(ENUMERABLE, config).trace
    blank = np.full(HORIZON, ACTIONS)
    marginals = [conditional_by_counting(JOINT, blank, t) for t in range(HORIZON)]
    counts = plan_counts(trace[:, -1], ACTIONS)
    assert fit_p_value(counts, np.einsum("a,b,c->abc", *marginals)) > ACCEPTED
    assert fit_p_value(counts, JOINT) < REJECTED


# What a plan holds.

CONFIGS = {
    "gibbs": GibbsConfig(HORIZON, iterations=5, temperature=0.7, score=True),
    "shooting": ShootingConfig(HORIZON, candidates=6, score=True),
    "cross entropy": CrossEntropyConfig(HORIZON, iterations=5, candidates=6, elites=2, score=True),
}
EACH_PLANNER = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)


@pytest.mark.parametrize(
    "config", [*CONFIGS.values(), GibbsConfig(HORIZON, 3, score=True, score_trace=True)]
)
def test_plan_is_the_end_of_its_trace_with_its_exact_energy(config):
    plan = plans_of(ENUMERABLE, config, chains=50)
    iterations = getattr(config, "iterations", 1)
    assert plan.actions.shape == (50, HORIZON)
    assert plan.trace.shape == (50, iterations, HORIZON)
    assert plan.actions.dtype == plan.trace.dtype == np.int32
    assert ((plan.trace >= 0) & (plan.trace < ACTIONS)).all()
    np.testing.assert_array_equal(plan.trace[:, -1], plan.actions)
    np.testing.assert_allclose(plan.energy, joint_energies(plan.actions), rtol=1e-4)
    assert plan.satisfied.all()
    assert (plan.trace_energies is None) != getattr(config, "score_trace", False)
    if plan.trace_energies is not None:
        assert plan.trace_energies.shape == (50, iterations)
        np.testing.assert_allclose(plan.trace_energies, joint_energies(plan.trace), rtol=1e-4)


@pytest.mark.parametrize(
    "config",
    [
        GibbsConfig(HORIZON, iterations=2),
        ShootingConfig(HORIZON),
        CrossEntropyConfig(HORIZON, iterations=2),
    ],
)
def test_energies_are_returned_only_if_asked_for(config):
    plan = jax.eval_shape(
        lambda key: bind(ENUMERABLE, config)(TABLE, key, NO_TILT),
        jax.random.key(0),
    )
    assert plan.energy is None
    assert plan.trace_energies is None


@EACH_PLANNER
def test_plan_is_a_function_of_its_key(config):
    plan, again = plans_of(ENUMERABLE, config, chains=50), plans_of(ENUMERABLE, config, chains=50)
    jax.tree.map(np.testing.assert_array_equal, plan, again)
    other = plans_of(ENUMERABLE, config, chains=50, seed=1)
    assert (plan.actions != other.actions).any(-1).mean() > 0.2


def test_one_iteration_is_one_draw():
    plan = plans_of(ENUMERABLE, GibbsConfig(HORIZON, iterations=1), chains=50)
    assert plan.trace.shape == (50, 1, HORIZON)
    np.testing.assert_array_equal(plan.trace[:, 0], plan.actions)
    blank = np.full(HORIZON, ACTIONS)
    likely = [conditional_by_counting(JOINT, blank, t).argmax() for t in range(HORIZON)]
    assert (plan.actions == likely).all()


def best_of(probabilities, energies, count):
    """The distribution of the outcome of least energy among independent draws."""
    probabilities, energies = np.ravel(probabilities), np.ravel(energies)
    order = np.argsort(energies)
    # At least this energy: all draws at least this, less all draws at least the next.
    tail = np.append(np.cumsum(probabilities[order][::-1])[::-1], 0.0)
    result = np.zeros(len(order))
    result[order] = tail[:-1] ** count - tail[1:] ** count
    return result


@pytest.mark.parametrize("restarts", [1, 3])
def test_the_restart_of_least_energy_is_kept(restarts):
    # With one iteration a restart is a draw of the marginals, so the best is known exactly.
    config = GibbsConfig(HORIZON, 1, temperature=1.0, restarts=restarts, score=True)
    plan = plans_of(ENUMERABLE, config)
    blank = np.full(HORIZON, ACTIONS)
    marginals = [conditional_by_counting(JOINT, blank, t) for t in range(HORIZON)]
    start = np.einsum("a,b,c->abc", *marginals)
    counts = plan_counts(plan.actions, ACTIONS)
    assert fit_p_value(counts, best_of(start, -np.log(JOINT), restarts)) > ACCEPTED
    assert fit_p_value(counts, best_of(start, -np.log(JOINT), 4 - restarts)) < REJECTED
    np.testing.assert_array_equal(plan.trace[:, -1], plan.actions)
    np.testing.assert_allclose(plan.energy, joint_energies(plan.actions), rtol=1e-4)


def test_of_several_filled_plans_the_one_of_least_energy_is_kept():
    config = GibbsConfig(
        HORIZON, HORIZON, fill="confident", temperature=1.0, restarts=3, score_trace=True
    )
    plan = plans_of(ENUMERABLE, config)
    counts = plan_counts(plan.actions, ACTIONS)
    assert fit_p_value(counts, best_of(JOINT, -np.log(JOINT), 3)) > ACCEPTED
    assert fit_p_value(counts, JOINT) < REJECTED
    # What is not complete has no energy yet.
    assert np.isposinf(plan.trace_energies[:, :-1]).all()
    np.testing.assert_allclose(plan.trace_energies[:, -1], joint_energies(plan.actions), rtol=1e-4)


def test_greedy_search_from_the_total_alone_solves_an_additive_energy():
    additive = np.random.default_rng(4).normal(size=(HORIZON, ACTIONS)).astype(np.float32)
    energy = from_total(
        lambda params, context: None,
        lambda params, memory, actions: params[jnp.arange(HORIZON), actions].sum(),
        ACTIONS,
    )
    config = GibbsConfig(HORIZON, iterations=HORIZON + 1, order="sequential")
    plan = plans_of(energy, config, additive, None, chains=100)
    assert (plan.actions == additive.argmin(-1)).all()
    assert (plan.trace[:, 0] != additive.argmin(-1)).any()


# Random shooting and the cross-entropy method.


@functools.cache
def recording_planner(config, energy=ENUMERABLE):
    """A planner for one key, and the list of every plan whose total energy it asks for."""
    scored = []

    def total(params, memory, actions):
        jax.debug.callback(lambda a: scored.append(tuple(map(int, a))), actions)
        return energy.total(params, memory, actions)

    recording = energy._replace(total=total)
    planner = bind(recording, config)
    return quick_jit(lambda key: planner(TABLE, key, NO_TILT)), scored


def plan_and_scored(config, seed, energy=ENUMERABLE):
    planner, scored = recording_planner(config, energy)
    scored.clear()
    plan = jax.block_until_ready(planner(jax.random.key(seed)))
    jax.effects_barrier()
    return plan, list(scored)


@pytest.mark.parametrize("seed", range(3))
def test_shooting_returns_the_lowest_of_its_draws(seed):
    plan, draws = plan_and_scored(ShootingConfig(HORIZON, candidates=12, score=True), seed)
    assert len(draws) == 12
    assert len(set(draws)) > 1
    energies = joint_energies(np.array(draws))
    assert tuple(np.asarray(plan.actions)) == draws[int(np.argmin(energies))]
    assert float(plan.energy) == pytest.approx(energies.min(), rel=1e-4)


@pytest.mark.parametrize("candidates", [1, 6])
def test_shooting_draws_uniformly(candidates):
    plan = plans_of(ENUMERABLE, ShootingConfig(HORIZON, candidates))
    uniform = np.full(len(PLANS), 1 / len(PLANS))
    expected = best_of(uniform, -np.log(JOINT), candidates)
    assert fit_p_value(plan_counts(plan.actions, ACTIONS), expected) > ACCEPTED


@pytest.mark.parametrize("seed", range(3))
def test_cross_entropy_returns_the_best_of_its_last_round(seed):
    config = CrossEntropyConfig(HORIZON, 3, candidates=7, elites=2, keep_elites=False)
    plan, scored = plan_and_scored(config, seed)
    assert len(scored) == 3 * 7
    last = joint_energies(np.array(scored[-7:]))
    assert joint_energies(plan.actions) == pytest.approx(last.min())
    assert last.min() < last.max()
    np.testing.assert_array_equal(plan.trace[-1], plan.actions)


# Long plans are far apart, so that it is clear which child is whose.
LONG = from_total(
    lambda params, context: None,
    lambda params, memory, actions: jnp.sum(actions * 2.5 ** jnp.arange(12)),
    ACTIONS,
)


def test_cross_entropy_keeps_the_elites_and_breeds_from_each():
    config = CrossEntropyConfig(12, 2, candidates=12, elites=3)
    _, scored = plan_and_scored(config, 0, LONG)
    first, second = np.array(scored[:12]), np.array(scored[12:])
    elites = first[np.argsort(first @ 2.5 ** np.arange(12))[:3]]
    distances = (second[:, None] != elites[None]).sum(-1)  # [candidates, elites]
    assert sorted(distances.min(1)) == [0] * 3 + [1] * 9
    np.testing.assert_array_equal((distances == 0).sum(0), [1, 1, 1])
    np.testing.assert_array_equal((distances == 1).sum(0), [3, 3, 3])


def test_cross_entropy_starts_like_shooting():
    plan = plans_of(ENUMERABLE, CONFIGS["cross entropy"])
    uniform = np.full(len(PLANS), 1 / len(PLANS))
    expected = best_of(uniform, -np.log(JOINT), CONFIGS["cross entropy"].candidates)
    assert fit_p_value(plan_counts(plan.trace[:, 0], ACTIONS), expected) > ACCEPTED


@pytest.mark.parametrize("keep_elites", [True, False])
def test_kept_elites_never_let_the_best_energy_rise(keep_elites):
    config = CrossEntropyConfig(HORIZON, 8, candidates=5, elites=2, keep_elites=keep_elites)
    energies = joint_energies(plans_of(ENUMERABLE, config, chains=300).trace)
    rises = np.diff(energies, axis=1) > 1e-9
    # Without the elites it does rise, which shows that this can be seen.
    assert rises.any() != keep_elites
    assert (np.diff(energies, axis=1) < -0.1).any()


def test_a_child_differs_from_its_parent_in_one_token():
    config = CrossEntropyConfig(HORIZON, 20, candidates=1, elites=1, keep_elites=False)
    trace = plans_of(ENUMERABLE, config, chains=200).trace
    changed = trace[:, 1:] != trace[:, :-1]
    assert (changed.sum(-1) == 1).all()
    assert fit_p_value(changed.sum((0, 1)), np.full(HORIZON, 1 / HORIZON)) > ACCEPTED
    shifts = ((trace[:, 1:] - trace[:, :-1]) % ACTIONS)[changed]
    assert fit_p_value(np.bincount(shifts, minlength=ACTIONS), [0, 0.5, 0.5]) > ACCEPTED


# What no plan can begin with: as the end action is in a model of plans.
FORBIDDEN = NO_TILT.copy()
FORBIDDEN[0, 2] = -np.inf


def test_shooting_draws_uniformly_among_plans_that_can_be():
    plan = plans_of(ENUMERABLE, ShootingConfig(HORIZON, candidates=1), context=FORBIDDEN)
    can_be = (np.indices(JOINT.shape)[0] != 2) / (2 * ACTIONS ** (HORIZON - 1))
    assert fit_p_value(plan_counts(plan.actions, ACTIONS), can_be) > ACCEPTED


def test_no_child_is_forbidden_and_each_differs_from_its_parent():
    config = CrossEntropyConfig(HORIZON, 20, candidates=1, elites=1, keep_elites=False)
    trace = plans_of(ENUMERABLE, config, context=FORBIDDEN, chains=200).trace
    np.testing.assert_array_equal(np.unique(trace[..., 0]), [0, 1])
    assert ((trace[:, 1:] != trace[:, :-1]).sum(-1) == 1).all()
    # Where there is no other action, the same.
    only = FORBIDDEN.copy()
    only[0, 0] = -np.inf
    trace = plans_of(ENUMERABLE, config, context=only, chains=200).trace
    assert (trace[..., 0] == 1).all()
    changed = trace[:, 1:] != trace[:, :-1]
    assert fit_p_value([changed[..., 1].sum(), changed[..., 2].sum()], [0.5, 0.5]) > ACCEPTED
    assert (changed.sum(-1) == 0).mean() == pytest.approx(1 / HORIZON, abs=0.05)


def test_cross_entropy_solves_an_additive_energy():
    config = CrossEntropyConfig(HORIZON, 20, candidates=8, elites=2)
    tilt = np.random.default_rng(6).normal(size=(HORIZON, ACTIONS)).astype(np.float32)
    plan = plans_of(ENUMERABLE, config, np.zeros_like(TABLE), tilt, chains=200)
    best = tilt.argmax(-1)
    assert (plan.trace[:, 0] == best).all(-1).mean() < 0.5
    assert (plan.actions == best).all(-1).mean() > 0.98


# Beam search.


def slow_beam_search(joint, width):
    """The best beam after every position, with conditionals by counting."""
    beams, trace = [(0.0, ())], []
    for t in range(HORIZON):
        longer = []
        for energy, plan in beams:
            tokens = np.array([*plan, *[ACTIONS] * (HORIZON - t)])
            for action, p in enumerate(conditional_by_counting(joint, tokens, t)):
                longer.append((energy - np.log(p), (*plan, action)))
        beams = sorted(longer)[:width]
        trace.append([*beams[0][1], *[ACTIONS] * (HORIZON - 1 - t)])
    return np.array(trace)


@pytest.mark.parametrize("width", [1, 2, 9, 40])
def test_beam_search_against_a_slow_one(width):
    """As wide as there are ways to begin, it finds the likeliest plan; narrower, it may not."""
    found = []
    for seed in range(6):
        table = random_table(seed, HORIZON, ACTIONS)
        joint = joint_probabilities(table)
        plan = plans_of(ENUMERABLE, BeamConfig(HORIZON, width, score=True), table, chains=2)
        np.testing.assert_array_equal(plan.trace[0], slow_beam_search(joint, width))
        np.testing.assert_array_equal(plan.trace[0], plan.trace[1])  # nothing is drawn
        np.testing.assert_array_equal(plan.actions, plan.trace[:, -1])
        np.testing.assert_allclose(plan.energy, joint_energies(plan.actions, joint), rtol=1e-4)
        assert plan.satisfied.all() and plan.valid.all()
        found.append((plan.actions[0] == PLANS[joint.argmax()]).all())
    if width in (1, ACTIONS ** (HORIZON - 1), 40):
        assert all(found) == (width > 1)


def test_beam_search_of_a_batch_is_a_loop_over_its_contexts():
    config = BeamConfig(HORIZON, 2)
    keys, contexts = batch_of(9)
    plan = compile_planner(TILTED, config, (4,))(TABLE, keys, contexts)
    for row, tilt in enumerate(contexts["tilt"][:9]):
        joint = joint_probabilities(TABLE, tilt)
        np.testing.assert_array_equal(plan.trace[row], slow_beam_search(joint, 2))


def test_beam_search_obeys_a_constraint_where_its_beams_leave_a_choice():
    likeliest = PLANS[JOINT.argmax()]
    safe = constrain(
        ENUMERABLE, lambda tilt, actions: jnp.where((actions == likeliest).all(), 9.0, 0.0)
    )
    plan = plans_of(safe, BeamConfig(HORIZON, 9), chains=1)
    assert plan.satisfied.all()
    second = PLANS[np.argsort(JOINT.reshape(-1))[-2]]
    np.testing.assert_array_equal(plan.actions[0], second)


def test_beam_search_keeps_no_plan_that_is_forbidden_while_another_is_allowed():
    """A beam that leads into a dead end pays nothing there, and is the best by its sum."""
    table = np.zeros_like(TABLE)

    def forbids_first(context, actions):  # known only once there is a second action
        return jnp.where((actions[0] != 2) & (actions[1] < ACTIONS), jnp.inf, 0.0)

    tilt = np.zeros((HORIZON, ACTIONS), np.float32)
    tilt[0, 2] = -5.0  # the only allowed beginning is the unlikeliest
    for partial in (False, True):
        safe = constrain(ENUMERABLE, forbids_first, partial=partial)
        plan = plans_of(safe, BeamConfig(HORIZON, 40, score=True), table, tilt, chains=1)
        assert plan.actions[0, 0] == 2 and plan.satisfied.all()
        np.testing.assert_array_equal(plan.actions, plan.trace[:, -1])
        assert np.isfinite(plan.energy).all()


@pytest.mark.parametrize("temperature", [0.5, 1.0, 2.0])
def test_one_beam_that_is_drawn_samples_action_by_action(temperature):
    """At temperature 1 from the joint; else each action is more, or less, certain."""
    found = plans_of(ENUMERABLE, BeamConfig(HORIZON, 1, temperature)).actions
    exact = np.ones(len(PLANS))
    for row, plan in enumerate(PLANS):
        for t, action in enumerate(plan):
            tokens = np.array([*plan[:t], *[ACTIONS] * (HORIZON - t)])
            p = conditional_by_counting(JOINT, tokens, t) ** (1 / temperature)
            exact[row] *= p[action] / p.sum()
    assert fit_p_value(plan_counts(found, ACTIONS), exact) > ACCEPTED
    if temperature == 1:
        np.testing.assert_allclose(exact, JOINT.reshape(-1), rtol=1e-6)
    else:
        assert fit_p_value(plan_counts(found, ACTIONS), JOINT) < REJECTED


def test_two_beams_that_are_drawn_are_the_better_of_two_different_plans():
    """Drawn without replacement: {a, b} with probability p_a p_b / (1 - p_a) and the reverse."""
    table = 6 * TABLE  # where what was drawn before matters: the likeliest plan has 0.6
    p = joint_probabilities(table).reshape(-1)
    pairs = np.outer(p, p) / (1 - p)[:, None]
    np.fill_diagonal(pairs, 0)
    rank = np.argsort(np.argsort(-p))
    better = np.where(rank[:, None] < rank, np.arange(len(p))[:, None], np.arange(len(p)))
    exact = np.bincount(better.reshape(-1), pairs.reshape(-1), len(p))
    found = plans_of(ENUMERABLE, BeamConfig(HORIZON, 2, 1.0), table).actions
    assert fit_p_value(plan_counts(found, ACTIONS), exact) > ACCEPTED
    # The same with replacement is another distribution, and would be noticed.
    repeated = np.bincount(better.reshape(-1), np.outer(p, p).reshape(-1), len(p))
    assert fit_p_value(plan_counts(found, ACTIONS), repeated) < REJECTED


def test_the_coldest_beam_is_a_greedy_one():
    greedy = plans_of(ENUMERABLE, BeamConfig(HORIZON, 1), chains=1)
    cold = plans_of(ENUMERABLE, BeamConfig(HORIZON, 1, 1e-30), chains=20)
    np.testing.assert_array_equal(cold.actions, np.repeat(greedy.actions, 20, axis=0))
    assert plans_of(ENUMERABLE, BeamConfig(HORIZON, 40, 1e-30), chains=20).valid.all()


def test_as_many_hot_beams_as_there_are_plans_hold_the_likeliest():
    """All are drawn, in whatever order, and the best of them is kept."""
    plan = plans_of(ENUMERABLE, BeamConfig(HORIZON, 40, 1e30), chains=20)
    assert plan.valid.all() and (plan.actions == PLANS[JOINT.argmax()]).all()


@pytest.mark.parametrize("beams", [1, 40])
def test_no_beam_that_is_drawn_is_forbidden(beams):
    def no_first(context, actions):
        return jnp.where(actions[0] == 0, jnp.inf, 0.0)

    safe = constrain(ENUMERABLE, no_first, partial=True)
    plan = plans_of(safe, BeamConfig(HORIZON, beams, 1.0), chains=500)
    assert plan.satisfied.all() and plan.valid.all() and (plan.actions[:, 0] != 0).all()


def test_beam_search_needs_an_energy_of_plans_that_are_begun():
    with pytest.raises(ValueError, match="accepts_mask is False"):
        bind(FROM_TOTAL, BeamConfig(HORIZON))(TABLE, jax.random.key(0), NO_TILT)


# Planning under constraints. Context: a tilt and a price for each action at each position.


def priced(context, actions):
    return context["price"][jnp.arange(HORIZON), actions].sum()


CONSTRAINED = constrain(view(ENUMERABLE, lambda context: context["tilt"]), priced)


def prices(*forbidden, price=np.inf):
    result = np.zeros((HORIZON, ACTIONS), np.float32)
    for position, action in forbidden:
        result[position, action] = price
    return result


def breaks(plans, price):
    return price[np.arange(HORIZON), plans].sum(-1) > 0


CONSTRAINED_CONFIGS = {
    "gibbs": GibbsConfig(HORIZON, iterations=3, temperature=1.0, score=True, score_trace=True),
    "restarts": GibbsConfig(HORIZON, iterations=3, restarts=2, temperature=0.3, score=True),
    "shooting": ShootingConfig(HORIZON, candidates=2, score=True),
    "cross entropy": CrossEntropyConfig(HORIZON, 2, candidates=3, elites=1, score=True),
}
EACH_CONSTRAINED = pytest.mark.parametrize(
    "config", CONSTRAINED_CONFIGS.values(), ids=CONSTRAINED_CONFIGS
)


@EACH_CONSTRAINED
@pytest.mark.parametrize("price", [0.5, np.inf])
def test_a_plan_that_breaks_a_constraint_is_never_called_satisfied(config, price):
    price = prices((0, 0), (0, 1), (1, 1), (1, 2), (2, 0), (2, 2), price=price)
    plan = plans_of(CONSTRAINED, config, context={"tilt": NO_TILT, "price": price}, chains=300)
    broken = breaks(plan.actions, price)
    np.testing.assert_array_equal(plan.satisfied, ~broken)
    assert broken.any()
    assert not broken.all()
    # No NaN either, and an infinite price makes an infinite energy.
    penalties = price[np.arange(HORIZON), plan.actions].sum(-1)
    np.testing.assert_allclose(plan.energy, joint_energies(plan.actions) + penalties, rtol=1e-4)


@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_gibbs_finds_the_way_around_one_forbidden_action(seed, temperature):
    """Whatever is forbidden where: single steps lead back from the model's own plan."""
    config = GibbsConfig(HORIZON, iterations=13, temperature=temperature, order="sequential")
    position, action = np.random.default_rng(seed).integers(3, size=2)
    tilt = NO_TILT.copy()
    tilt[position, action] = 6.0  # the model insists on what is forbidden
    context = {"tilt": tilt, "price": prices((position, action))}
    plan = plans_of(CONSTRAINED, config, context=context, chains=100)
    assert breaks(plan.trace[:, 0], context["price"]).mean() > 0.9
    assert plan.satisfied.all()
    assert not breaks(plan.actions, context["price"]).any()


def test_a_growing_penalty_leads_out_of_several_violations():
    forbidden = [(0, 0), (0, 2), (1, 0), (1, 1), (2, 1), (2, 2)]
    price = prices(*forbidden, price=1e4)
    tilt = np.where(price > 0, 6.0, 0.0).astype(np.float32)
    config = GibbsConfig(HORIZON, iterations=1 + HORIZON, order="sequential")
    context = {"tilt": tilt, "price": price}
    plan = plans_of(CONSTRAINED, config, context=context, chains=20)
    assert breaks(plan.trace[:, 0], price).all()
    assert plan.satisfied.all()
    np.testing.assert_array_equal(plan.actions, np.broadcast_to([1, 2, 0], (20, HORIZON)))


def test_constrained_gibbs_samples_the_joint_given_the_constraint():
    price = prices((0, 0), (2, 1))
    config = GibbsConfig(HORIZON, iterations=50, temperature=1.0)
    plan = plans_of(CONSTRAINED, config, context={"tilt": NO_TILT, "price": price})
    # Two violations at once cannot be left by single steps: those chains found nothing.
    found = plan.actions[plan.satisfied]
    assert len(found) > CHAINS / 2
    allowed = JOINT.copy()
    allowed[0] = allowed[:, :, 1] = 0
    assert fit_p_value(plan_counts(found, ACTIONS), allowed / allowed.sum()) > ACCEPTED


@EACH_CONSTRAINED
def test_if_everything_is_forbidden_no_plan_is_satisfied_and_nothing_is_nan(config):
    context = {"tilt": NO_TILT, "price": np.full((HORIZON, ACTIONS), np.inf, np.float32)}
    plan = plans_of(CONSTRAINED, config, context=context, chains=300)
    assert not plan.satisfied.any()
    assert np.isposinf(plan.energy).all()
    assert plan.trace_energies is None or np.isposinf(plan.trace_energies).all()
    assert ((plan.trace >= 0) & (plan.trace < ACTIONS)).all()


def test_infinite_totals_do_not_overwrite_actions_that_cannot_help():
    """Position 1 has to change; resampling position 0 first must not lose its action."""

    def total(params, memory, actions):
        return jnp.where(jnp.any(actions == 0), jnp.inf, 0.0)

    energy = from_total(lambda params, context: None, total, ACTIONS)
    config = GibbsConfig(2, iterations=9, order="sequential")
    plan = plans_of(energy, config, None, None, chains=100)
    reachable = (plan.trace[:, 0] == 0).sum(-1) <= 1
    assert reachable.any()
    assert not (plan.actions[reachable] == 0).any()


# Batches.


def batch_of(batch, seed=0):
    """Keys and contexts, all different, as NumPy arrays."""
    tilts = np.random.default_rng(seed).normal(size=(batch, HORIZON, ACTIONS)).astype(np.float32)
    return plan_keys(seed, np.arange(batch), np.zeros(batch, int)), {"tilt": tilts}


TILTED = view(ENUMERABLE, lambda context: context["tilt"])
SIZES = (1, 2, 7, 8, 9, 20)


@functools.cache
def batched(config):
    sizes = (8, 2) if isinstance(config, GibbsConfig) else (7,)
    return compile_planner(TILTED, config, sizes)


@functools.cache
def one_by_one(config):
    """The plans of 20 contexts, each from its own unbatched call."""
    keys, contexts = batch_of(20)
    planner = bind(TILTED, config)
    single = quick_jit(lambda k, c: planner(TABLE, k, c))
    plans = [single(keys[i], {"tilt": contexts["tilt"][i]}) for i in range(20)]
    return jax.tree.map(lambda *rows: np.stack(rows), *plans)


@EACH_PLANNER
@pytest.mark.parametrize("batch", SIZES)
def test_a_batch_is_a_loop_over_its_contexts(batch, config):
    keys, contexts = batch_of(20)
    contexts = {"tilt": contexts["tilt"][:batch]}
    plan = batched(config)(TABLE, keys[:batch], contexts)
    expected = jax.tree.map(lambda leaf: leaf[:batch], one_by_one(config))
    np.testing.assert_array_equal(plan.actions, expected.actions)
    np.testing.assert_array_equal(plan.trace, expected.trace)
    np.testing.assert_array_equal(plan.satisfied, expected.satisfied)
    np.testing.assert_allclose(plan.energy, expected.energy, rtol=1e-5)


@EACH_PLANNER
def test_a_context_changes_its_own_plan_only(config):
    keys, contexts = batch_of(9)
    before = batched(config)(TABLE, keys, contexts)
    changed = contexts["tilt"].copy()
    target = (np.asarray(before.actions[4]) + 1) % ACTIONS
    changed[4, np.arange(HORIZON), target] += 20.0
    after = batched(config)(TABLE, keys, {"tilt": changed})
    others = np.arange(9) != 4
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(np.asarray(a)[others], np.asarray(b)[others]),
        before,
        after,
    )
    assert (after.actions[4] != before.actions[4]).any()


def test_parameters_are_an_argument():
    planner = batched(CONFIGS["gibbs"])
    keys, contexts = batch_of(8)
    peaks = np.full((ACTIONS,) * HORIZON, -20.0, np.float32)
    for peak in ((0, 1, 2), (2, 2, 0)):
        table = peaks.copy()
        table[peak] = 20.0
        assert (np.asarray(planner(table, keys, contexts).actions) == peak).all()


@settings(max_examples=300, deadline=None)
@given(st.integers(1, 500), st.sets(st.integers(1, 70), min_size=1, max_size=4))
def test_chunks_cover_every_row_exactly_once(batch, sizes):
    sizes = sorted(sizes)
    chunks = split_batch(batch, sizes)
    covered = [row for start, _, used in chunks for row in range(start, start + used)]
    assert covered == list(range(batch))
    assert all(size in sizes for _, size, _ in chunks)
    assert all(size == used for _, size, used in chunks[:-1])
    _, size, used = chunks[-1]
    assert 1 <= used <= size


@pytest.mark.parametrize(
    ("batch", "sizes", "chunks"),
    [
        (64, (32, 128), [32, 32]),
        (40, (16, 128), [16, 16, 16]),
        (4, (1, 16), [1, 1, 1, 1]),
        (5, (1, 16), [16]),
        (110, (32, 128), [128]),
    ],
)
def test_a_chunk_is_not_padded_to_several_times_what_is_left(batch, sizes, chunks):
    assert [size for _, size, _ in split_batch(batch, sizes)] == chunks


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 150), st.sets(st.integers(1, 30), min_size=1, max_size=3))
def test_sizes_up_to_a_batch_are_those_that_its_chunks_need(batch, sizes):
    planner = compile_planner(TILTED, CONFIGS["gibbs"], sorted(sizes))
    needed = {size for b in range(1, batch + 1) for _, size, _ in split_batch(b, sorted(sizes))}
    assert planner.sizes_up_to(batch) == sorted(needed)


def test_keys_depend_on_seed_episode_and_replan_and_not_on_the_row():
    episodes, replans = np.array([3, 0, 3, 1]), np.array([0, 2, 1, 2])
    data = np.asarray(jax.random.key_data(plan_keys(7, episodes, replans)))
    shuffled = jax.random.key_data(plan_keys(7, episodes[::-1], replans[::-1]))
    np.testing.assert_array_equal(shuffled, data[::-1])
    alone = jax.random.key_data(plan_keys(7, episodes[1:2], replans[1:2]))
    np.testing.assert_array_equal(alone, data[1:2])
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2)
    keys = [jax.random.key_data(plan_keys(seed, grid[:, 0], grid[:, 1])) for seed in (0, 1)]
    assert len(np.unique(np.concatenate(keys), axis=0)) == 2 * len(grid)
    np.testing.assert_array_equal(
        plan_keys(0, episodes, np.zeros(4)), plan_keys(0, episodes, [0] * 4)
    )


# Mistakes.


@only_long
@settings(max_examples=12, deadline=None)
@given(st.data())
def test_plans_of_any_shape(data):
    """Actions in range, the trace ends with the plan, and the key decides it."""
    horizon, actions = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 4))
    batch = data.draw(st.integers(1, 9))
    config = data.draw(
        st.one_of(
            st.builds(
                GibbsConfig,
                horizon=st.just(horizon),
                iterations=st.integers(1, 5),
                resampled=st.integers(1, horizon),
                order=st.sampled_from(ORDERS),
                temperature=st.sampled_from([0.0, 0.7]),
                restarts=st.integers(1, 2),
            ),
            st.builds(ShootingConfig, horizon=st.just(horizon), candidates=st.integers(1, 5)),
            st.builds(
                CrossEntropyConfig,
                horizon=st.just(horizon),
                iterations=st.integers(1, 3),
                candidates=st.integers(3, 6),
                elites=st.integers(1, 3),
                keep_elites=st.booleans(),
            ),
        )
    )
    energy = enumerable_energy(horizon, actions)
    planner = compile_planner(energy, config, (4,), jax.devices()[:1])
    table = random_table(0, horizon, actions)
    tilts = np.zeros((batch, horizon, actions), np.float32)
    keys = plan_keys(1, np.arange(batch), np.zeros(batch, int))
    plan = planner(table, keys, tilts)
    assert plan.actions.shape == (batch, horizon)
    assert plan.trace.shape[::2] == (batch, horizon)
    np.testing.assert_array_equal(plan.trace[:, -1], plan.actions)
    assert ((plan.trace >= 0) & (plan.trace < actions)).all()
    assert plan.satisfied.all()
    assert plan.valid.all()
    again = planner(table, keys, tilts)
    jax.tree.map(np.testing.assert_array_equal, plan, again)


@pytest.mark.parametrize("devices", [1, 2])  # the other planners here have all 8
def test_plans_do_not_depend_on_how_many_devices_share_them(devices):
    keys, contexts = batch_of(20)
    config = CONFIGS["gibbs"]
    planner = compile_planner(TILTED, config, (8,), jax.devices()[:devices])
    plan = planner(TABLE, keys, contexts)
    expected = one_by_one(config)
    np.testing.assert_array_equal(plan.trace, expected.trace)
    np.testing.assert_allclose(plan.energy, expected.energy, rtol=1e-5)


def test_parameters_in_another_place_of_the_tree_are_other_parameters():
    keys, contexts = batch_of(8)
    table = jnp.asarray(TABLE)
    either = TILTED._replace(
        encode=lambda p, c: TILTED.encode(-p["b"] if p["a"] is None else p["a"], c)
    )
    planner = compile_planner(either, CONFIGS["gibbs"], (8,))
    first = planner({"a": table, "b": None}, keys, contexts)
    second = planner({"a": None, "b": table}, keys, contexts)
    expected = batched(CONFIGS["gibbs"])
    np.testing.assert_array_equal(first.actions, expected(table, keys, contexts).actions)
    np.testing.assert_array_equal(second.actions, expected(-table, keys, contexts).actions)


# Parameters: a table, and what stands where an energy should be.
UNDEFINED_TOTAL = ENUMERABLE._replace(
    encode=lambda params, context: ENUMERABLE.encode(params[0], context),
    total=lambda params, memory, actions: params[1],
)


def _undefined_at_first(params, memory, actions, positions):
    energies = ENUMERABLE.conditional(params[0], memory, actions, positions)
    return jnp.where(jnp.all(actions == ACTIONS), energies.at[0, 1].set(params[1]), energies)


UNDEFINED_STEP = UNDEFINED_TOTAL._replace(conditional=_undefined_at_first)
EACH_UNDEFINED = pytest.mark.parametrize("undefined", [np.nan, -np.inf])


@EACH_UNDEFINED
@pytest.mark.parametrize(
    "config",
    [
        GibbsConfig(HORIZON, 3, score=True),
        GibbsConfig(HORIZON, 3, score_trace=True),
        GibbsConfig(HORIZON, 3, restarts=2),
        ShootingConfig(HORIZON),
        CrossEntropyConfig(HORIZON),
    ],
)
def test_a_plan_whose_energy_is_no_number_is_not_valid(config, undefined):
    plan = plans_of(UNDEFINED_TOTAL, config, (TABLE, np.float32(undefined)), chains=2)
    assert not plan.valid.any()
    assert plans_of(UNDEFINED_TOTAL, config, (TABLE, np.float32(1)), chains=2).valid.all()


@EACH_UNDEFINED
def test_a_step_whose_energies_are_no_numbers_is_not_valid(undefined):
    params = (TABLE, np.float32(undefined))
    plan = plans_of(UNDEFINED_STEP, GibbsConfig(HORIZON, 3), params, chains=2)
    assert not plan.valid.any()


def test_parameters_are_placed_again_only_when_they_change():
    keys, contexts = batch_of(8)
    planner = batched(CONFIGS["gibbs"])
    first, second = jnp.asarray(TABLE), jnp.asarray(random_table(5, HORIZON, ACTIONS))
    expected = [np.asarray(planner(table, keys, contexts).actions) for table in (first, second)]
    assert (expected[0] != expected[1]).any()
    for table, plan in ((first, 0), (first, 0), (second, 1), (first, 0)):
        np.testing.assert_array_equal(planner(table, keys, contexts).actions, expected[plan])
    # An array of NumPy that its owner writes to is not remembered.
    table = np.array(first)
    np.testing.assert_array_equal(planner(table, keys, contexts).actions, expected[0])
    table[...] = second
    np.testing.assert_array_equal(planner(table, keys, contexts).actions, expected[1])


@EACH_PLANNER
def test_an_energy_that_is_nan_is_an_error_and_not_a_plan(config):
    keys, contexts = batch_of(20)
    contexts["tilt"][3, 1] = np.nan
    with pytest.raises(NotANumber, match=r"1 of 20 contexts \(the first is context 3\)") as error:
        batched(config)(TABLE, keys, contexts)
    assert str(pickle.loads(pickle.dumps(error.value))) == str(error.value)
    plan = error.value.plan
    assert plan.valid.sum() == 19
    np.testing.assert_array_equal(plan.actions[4:], one_by_one(config).actions[4:])


def test_keys_may_be_typed():
    keys, contexts = batch_of(8)
    plan, same = (
        batched(CONFIGS["gibbs"])(TABLE, k, contexts)
        for k in (keys, jax.random.wrap_key_data(keys))
    )
    jax.tree.map(np.testing.assert_array_equal, plan, same)


def test_keys_that_are_not_one_for_each_context_are_refused():
    keys, contexts = batch_of(2)
    for wrong in (keys[0], keys[None], jax.random.key(0), jax.random.wrap_key_data(keys)[None]):
        with pytest.raises(ValueError, match="expected one for each context"):
            batched(CONFIGS["gibbs"])(TABLE, wrong, contexts)


def test_contexts_of_words_are_refused():
    keys, contexts = batch_of(2)
    with pytest.raises(ValueError, match=r"context\['mission'\] holds <U\d+, not numbers"):
        batched(CONFIGS["gibbs"])(TABLE, keys, {**contexts, "mission": np.array(["go", "stay"])})


@pytest.mark.parametrize("kind", [jnp.bfloat16, np.float16, np.uint64, bool])
def test_contexts_of_every_type_that_jax_has_are_taken(kind):
    keys, contexts = batch_of(2)
    plan = batched(CONFIGS["gibbs"])
    expected = plan(TABLE, keys, contexts)
    found = plan(TABLE, keys, {**contexts, "more": np.zeros(2, kind)})
    np.testing.assert_array_equal(found.actions, expected.actions)


@pytest.mark.parametrize("keys", [5, None, "keys", []])
def test_keys_that_are_no_array_are_refused(keys):
    with pytest.raises(ValueError, match="keys must be an array|no contexts"):
        batched(CONFIGS["gibbs"])(TABLE, keys, batch_of(2)[1])


@pytest.mark.parametrize("devices", ["cpu", 2, ["cpu"]])
def test_devices_are_devices(devices):
    with pytest.raises(ValueError, match="devices must be a sequence"):
        compile_planner(TILTED, CONFIGS["gibbs"], (1,), devices)


def test_keys_may_be_a_list():
    keys, contexts = batch_of(2)
    plan = batched(CONFIGS["gibbs"])
    found = plan(TABLE, [*keys], contexts)
    np.testing.assert_array_equal(found.actions, plan(TABLE, keys, contexts).actions)


def test_no_contexts_are_refused():
    assert plan_keys(0, np.arange(0), np.arange(0)).shape == (0, 2)
    keys, contexts = batch_of(2)
    with pytest.raises(ValueError, match="no contexts"):
        batched(CONFIGS["gibbs"])(TABLE, keys[:0], {"tilt": contexts["tilt"][:0]})


@pytest.mark.parametrize("shape", [(3, HORIZON, ACTIONS), (1, HORIZON, ACTIONS), ()])
def test_contexts_that_do_not_match_the_keys_are_refused(shape):
    keys, _ = batch_of(2)
    with pytest.raises(ValueError, match=r"context\['tilt'\] has shape .* number of keys, 2"):
        batched(CONFIGS["gibbs"])(TABLE, keys, {"tilt": np.zeros(shape, np.float32)})


WIDE = [
    np.array([0, 2**32 + 2]), np.array([0, 2**31]), np.array([-(2**31) - 1, 0]),
    np.array([0, 2**32], np.uint64), np.array([0, 1e300]), np.array([np.inf, -1e39]),
]  # fmt: skip


@pytest.mark.parametrize("wide", WIDE)
def test_numbers_that_jax_would_change_are_refused(wide):
    keys, contexts = batch_of(2)
    plan = batched(CONFIGS["gibbs"])
    with pytest.raises(UserError, match=r"context\['more'\]\[0\] holds .*does not fit"):
        plan(TABLE, keys, {**contexts, "more": [wide]})
    with pytest.raises(UserError, match=r"params\['more'\] holds .*does not fit"):
        plan({"table": TABLE, "more": wide}, keys, contexts)


def test_numbers_of_64_bits_that_fit_are_taken():
    for fits in (
        [2**31 - 1, -(2**31)], np.array([2**32 - 1], np.uint64), [np.nan, np.inf, -np.inf, 3e38],
        [1 / 3], [], np.array([2**32 - 1], np.uint32), jnp.array([1]), ["words are not numbers"],
    ):  # fmt: skip
        check_fit("context", {"x": fits if isinstance(fits, jax.Array) else np.array(fits)})


@pytest.mark.parametrize("edge", [0, 1, 2])
@pytest.mark.parametrize("wrong", [-1, 2**32, 5.9, np.nan, 1e300, -1.0])
def test_keys_of_other_numbers_than_seeds_are_refused(edge, wrong):
    arguments = [0, np.array([0]), np.array([0])]
    arguments[edge] = np.array([wrong]) if edge else wrong
    with pytest.raises(UserError, match=("seed", "episode", "replan")[edge] + " must be"):
        plan_keys(*arguments)
    with pytest.raises(UserError, match="2 episodes, but 1 replans"):
        plan_keys(0, np.arange(2), np.arange(1))


def test_raw_keys_of_another_type_are_refused():
    keys, contexts = batch_of(2)
    for wrong in (keys.astype(np.int64), keys[:, :1], np.tile(keys, 2)):
        with pytest.raises(UserError, match=r"raw keys must be \[B, 2\] uint32"):
            batched(CONFIGS["gibbs"])(TABLE, wrong, contexts)


def test_plans_do_not_depend_on_the_kind_of_keys_that_jax_makes():
    keys, contexts = batch_of(2)
    plan = batched(CONFIGS["gibbs"])
    expected = plan(TABLE, keys, contexts)
    with jax.default_prng_impl("rbg"):
        again, _ = batch_of(2)
        np.testing.assert_array_equal(again, keys)
        np.testing.assert_array_equal(plan(TABLE, again, contexts).actions, expected.actions)


@pytest.mark.parametrize(
    "chunk_sizes", [(), (0,), (8, -1), (4.0,), (True,), ("8",), 8, "8", (2**31,), (None,)]
)
def test_impossible_chunk_sizes_are_refused(chunk_sizes):
    with pytest.raises(ValueError, match="chunk sizes"):
        compile_planner(TILTED, CONFIGS["gibbs"], chunk_sizes)


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (GibbsConfig, {"horizon": 0}, "horizon must be at least 1, got 0"),
        (GibbsConfig, {"iterations": 0}, "iterations must be at least 1, got 0"),
        (GibbsConfig, {"resampled": 0}, "resampled must be at least 1, got 0"),
        (GibbsConfig, {"restarts": -1}, "restarts must be at least 1, got -1"),
        (GibbsConfig, {"horizon": 3, "resampled": 4}, "resampled is 4, .* the horizon 3"),
        (GibbsConfig, {"order": "backwards"}, "unknown order 'backwards': .*sequential"),
        (GibbsConfig, {"fill": "at once"}, "unknown fill 'at once': .*confident"),
        (GibbsConfig, {"fill": "margin", "horizon": 5, "iterations": 2, "resampled": 2}, "needs 3"),
        (ShootingConfig, {"horizon": -2}, "horizon must be at least 1, got -2"),
        (ShootingConfig, {"candidates": 0}, "candidates must be at least 1, got 0"),
        (CrossEntropyConfig, {"horizon": 0}, "horizon must be at least 1"),
        (CrossEntropyConfig, {"iterations": 0}, "iterations must be at least 1"),
        (CrossEntropyConfig, {"candidates": 0}, "candidates must be at least 1"),
        (CrossEntropyConfig, {"elites": 0}, "elites must be at least 1"),
        (CrossEntropyConfig, {"candidates": 2, "elites": 3}, "3 elites out of 2 candidates"),
        (BeamConfig, {"horizon": 0}, "horizon must be at least 1"),
        (BeamConfig, {"beams": 0}, "beams must be at least 1"),
        (BeamConfig, {"temperature": -1.0}, "a temperature must be in"),
    ],
)
def test_impossible_configurations_are_refused(make, options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


@pytest.mark.parametrize("temperature", [-0.1, 1e31, float("inf"), float("nan"), "1", None, True])
def test_impossible_temperatures_are_refused(temperature):
    with pytest.raises(ValueError, match="temperature must be"):
        GibbsConfig(temperature=temperature)


def test_only_planner_configurations_have_a_planner():
    with pytest.raises(TypeError, match="no planner takes a dict"):
        bind(ENUMERABLE, {"horizon": 3})
