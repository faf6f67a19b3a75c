import dataclasses
import functools
import pickle
from typing import NamedTuple

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
    BeamConfig,
    CrossEntropyConfig,
    GibbsConfig,
    PlannerConfig,
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


# Samplers against exact distributions over all plans.

UNIFORM = np.full(len(PLANS), 1 / len(PLANS))
BLANK = np.full(HORIZON, ACTIONS)
MARGINALS = [conditional_by_counting(JOINT, BLANK, t) for t in range(HORIZON)]
INDEPENDENT = np.einsum("a,b,c->abc", *MARGINALS)
FORBIDDEN = NO_TILT.copy()  # an action that no plan can begin with, as the end action is
FORBIDDEN[0, 2] = -np.inf
POSSIBLE = (PLANS[:, 0] != 2) / 18
OTHER_TABLE, WEIGHTS = random_table(1, HORIZON, ACTIONS), (0.7, 1.5)
STEEP = 6 * TABLE  # the likeliest plan has 0.6, so it matters what was drawn before


def _guarded_total(params, memory, actions):
    return jnp.where(actions[0] == 2, jnp.inf, ENUMERABLE.total(params, memory, actions))


def _blind_to_other_actions(params, memory, actions, positions):
    masked = jnp.full_like(actions, ACTIONS)
    return ENUMERABLE.conditional(params, memory, masked, positions)


def best_of(probabilities, count):
    """The distribution of the plan of least energy among independent draws."""
    probabilities, energies = np.ravel(probabilities), -np.log(JOINT.reshape(-1))
    order = np.argsort(energies)
    # At least this energy: all draws at least this, less all draws at least the next.
    tail = np.append(np.cumsum(probabilities[order][::-1])[::-1], 0.0)
    result = np.zeros(len(order))
    result[order] = tail[:-1] ** count - tail[1:] ** count
    return result


def action_by_action(temperature):
    """The distribution of plans whose actions are drawn from left to right."""
    exact = np.ones(len(PLANS))
    for row, plan in enumerate(PLANS):
        for t, action in enumerate(plan):
            tokens = np.array([*plan[:t], *[ACTIONS] * (HORIZON - t)])
            p = conditional_by_counting(JOINT, tokens, t) ** (1 / temperature)
            exact[row] *= p[action] / p.sum()
    return exact


def better_of_two(joint, replaced):
    """The better of two plans: {a, b} has probability p_a p_b / (1 - p_a) and the reverse.

    Args:
        joint: `[A] * T`.
        replaced: whether the second may be the first again.
    """
    p = joint.reshape(-1)
    pairs = np.outer(p, p)
    if not replaced:
        pairs = pairs / (1 - p)[:, None]
        np.fill_diagonal(pairs, 0)
    rank = np.argsort(np.argsort(-p))
    better = np.where(rank[:, None] < rank, np.arange(len(p))[:, None], np.arange(len(p)))
    return np.bincount(better.reshape(-1), pairs.reshape(-1), len(p))


class Sampler(NamedTuple):
    """A planner, the exact distribution of its plans, and one that they must not fit."""

    config: PlannerConfig
    exact: np.ndarray
    wrong: np.ndarray
    energy: Energy = ENUMERABLE
    params: object = TABLE
    context: np.ndarray = NO_TILT


def _gibbs(iterations=50, temperature=1.0, **options):
    return GibbsConfig(HORIZON, iterations, temperature=temperature, **options)


GUARDED = from_total(ENUMERABLE.encode, _guarded_total, ACTIONS)
PRODUCT = WEIGHTS[0] * TABLE.astype(np.float64) + WEIGHTS[1] * OTHER_TABLE
STEEP_JOINT = joint_probabilities(STEEP)
SAMPLERS = {
    "gibbs": Sampler(_gibbs(), JOINT, INDEPENDENT),
    "sequential gibbs": Sampler(_gibbs(order="sequential"), JOINT, INDEPENDENT),
    "gibbs on totals": Sampler(_gibbs(), JOINT, INDEPENDENT, FROM_TOTAL),
    "cold gibbs": Sampler(
        _gibbs(temperature=0.5), joint_probabilities(2 * TABLE.astype(np.float64)), JOINT
    ),
    "composed": Sampler(
        _gibbs(60), joint_probabilities(PRODUCT), JOINT,
        compose([ENUMERABLE, ENUMERABLE], WEIGHTS), (TABLE, OTHER_TABLE),
    ),
    "first pass": Sampler(_gibbs(1), INDEPENDENT, JOINT),
    "all positions in each pass": Sampler(_gibbs(3, resampled=HORIZON), INDEPENDENT, JOINT),
    "first plan of totals": Sampler(_gibbs(1), UNIFORM, JOINT, FROM_TOTAL),
    # With an end action in the first place every plan is as bad, so none would be left.
    "first plan that is possible": Sampler(_gibbs(1), POSSIBLE, UNIFORM, GUARDED),
    "best restart": Sampler(_gibbs(1, restarts=3), best_of(INDEPENDENT, 3), INDEPENDENT),
    "best filled restart": Sampler(
        _gibbs(HORIZON, fill="confident", restarts=3), best_of(JOINT, 3), JOINT
    ),
    **{
        f"{fill} fill": Sampler(_gibbs(HORIZON, fill=fill), JOINT, INDEPENDENT)
        for fill in FILLS
        if fill != "together"
    },
    "shooting": Sampler(ShootingConfig(HORIZON, 6), best_of(UNIFORM, 6), UNIFORM),
    "possible shot": Sampler(ShootingConfig(HORIZON, 1), POSSIBLE, UNIFORM, context=FORBIDDEN),
    "first cross entropy": Sampler(
        CrossEntropyConfig(HORIZON, 1, 6, 2), best_of(UNIFORM, 6), UNIFORM
    ),
    "beam": Sampler(BeamConfig(HORIZON, 1, 1.0), JOINT, INDEPENDENT),
    "warm beam": Sampler(BeamConfig(HORIZON, 1, 2.0), action_by_action(2.0), JOINT),
    "two beams": Sampler(
        BeamConfig(HORIZON, 2, 1.0), better_of_two(STEEP_JOINT, False),
        better_of_two(STEEP_JOINT, True), params=STEEP,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SAMPLERS)
def test_plans_are_drawn_from_the_exact_distribution(name):
    config, exact, wrong, energy, params, context = SAMPLERS[name]
    counts = plan_counts(plans_of(energy, config, params, context).actions, ACTIONS)
    assert fit_p_value(counts, exact) > ACCEPTED
    assert total_variation(counts, exact) < 0.04
    assert fit_p_value(counts, wrong) < REJECTED


@pytest.mark.parametrize(
    ("energy", "config"),
    [
        (ENUMERABLE, _gibbs(temperature=1.25)),
        (ENUMERABLE._replace(conditional=_blind_to_other_actions), _gibbs()),
        (ENUMERABLE, _gibbs(2, fill="random", resampled=2)),
    ],
    ids=["warm", "blind", "two at once"],
)
def test_a_broken_sampler_does_not_pass_for_the_joint(energy, config):
    counts = plan_counts(plans_of(energy, config).actions, ACTIONS)
    assert fit_p_value(counts, JOINT) < REJECTED
    assert total_variation(counts, JOINT) > 0.06


@functools.cache
def greedy_traces(order, fill="together"):
    """Traces `[tables, N, T]` at temperature 0, each on a joint of its own, and the joints."""
    tables = np.stack([random_table(seed, HORIZON, ACTIONS) for seed in range(200)])
    config = GibbsConfig(HORIZON, iterations=16, order=order, fill=fill)
    keys = jax.random.split(jax.random.key(1), len(tables))
    plan = quick_jit(jax.vmap(lambda p, k: bind(ENUMERABLE, config)(p, k, NO_TILT)))(tables, keys)
    return np.asarray(plan.trace), [joint_probabilities(table) for table in tables]


GREEDY = [("random", "together"), ("sequential", "together"), ("uncertain", "random")]


@pytest.mark.parametrize(("order", "fill"), GREEDY)
def test_greedy_gibbs_never_raises_the_joint_energy(order, fill):
    traces, joints = greedy_traces(order, fill)
    if fill != "together":
        assert (traces[:, HORIZON - 2] == ACTIONS).any(axis=-1).all()
        traces = traces[:, HORIZON - 1 :]
    changes = np.array([np.diff(joint_energies(t, j)) for t, j in zip(traces, joints, strict=True)])
    assert (changes <= 1e-5).all()
    assert (changes < -0.1).sum() > (50 if fill == "together" else 3)


def test_greedy_sweeps_start_from_the_likeliest_actions_and_end_where_no_single_one_helps():
    traces, joints = greedy_traces("sequential")
    for trace, joint in zip(traces, joints, strict=True):
        for tokens, plan in ((BLANK, trace[0]), (trace[-1], trace[-1])):
            for t in range(HORIZON):
                conditional = conditional_by_counting(joint, tokens, t)
                assert conditional[plan[t]] == pytest.approx(conditional.max(), rel=1e-5)


# Filling a plan position by position.


@pytest.mark.parametrize("fill", [fill for fill in FILLS if fill != "together"])
def test_each_pass_fills_so_many_and_keeps_them(fill):
    trace = plans_of(ENUMERABLE, _gibbs(2, fill=fill, resampled=2), chains=200).trace
    known = trace < ACTIONS  # [chains, N, T]
    assert (known.sum(-1) == [2, 3]).all()
    assert ((trace[:, 0] == trace[:, 1]) | ~known[:, 0]).all()
    if fill == "sequential":
        assert known[:, 0, :2].all()


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


# Which positions are resampled.

CERTAINTY = np.array([2.0, 0.5, 3.0, 1.0], np.float32)  # of the four positions


def _next_action(params, memory, actions, positions):
    wanted = (actions[positions] + 1) % 5
    energies = jnp.where(jnp.arange(5) == wanted[:, None], 0.0, 1.0)
    return energies * jnp.array(CERTAINTY)[positions][:, None]


# Every resampled action goes up by one, so the trace tells which positions were resampled.
COUNTER = Energy(lambda params, context: None, _next_action, lambda *_: jnp.zeros(()), 5)


def resampled_positions(config, chains):
    """Which positions each iteration after the first changed: `[chains, N - 1, T]`."""
    steps = np.diff(plans_of(COUNTER, config, None, None, chains).trace, axis=1) % 5
    assert np.isin(steps, (0, 1)).all()
    return steps.astype(bool)


@pytest.mark.parametrize("resampled", [1, 2])
def test_random_order_is_uniform_over_sets_of_distinct_positions(resampled):
    changed = resampled_positions(GibbsConfig(4, iterations=4, resampled=resampled), 1500)
    assert (changed.sum(-1) == resampled).all()
    sets = changed.reshape(-1, 4) @ (2 ** np.arange(4))
    possible = np.array([bin(i).count("1") == resampled for i in range(16)])
    counts = np.bincount(sets, minlength=16)
    assert fit_p_value(counts, possible / possible.sum()) > ACCEPTED
    # Iterations choose independently.
    again = np.mean((changed[:, 0] == changed[:, 1]).all(-1))
    assert again == pytest.approx(1 / possible.sum(), abs=0.05)


@pytest.mark.parametrize(
    ("order", "resampled", "expected"),
    [
        ("sequential", 1, [{0}, {1}, {2}, {3}, {0}, {1}]),
        ("sequential", 3, [{0, 1, 2}, {3, 0, 1}, {2, 3, 0}, {1, 2, 3}]),
        ("uncertain", 1, [{1}, {3}, {0}, {2}, {1}, {3}]),
        ("uncertain", 2, [{1, 3}, {0, 2}, {1, 3}]),
    ],
)
def test_every_position_is_resampled_before_any_is_again(order, resampled, expected):
    """From left to right and around, or those that are least certain first."""
    config = GibbsConfig(4, 1 + len(expected), resampled, order=order)
    for row in resampled_positions(config, chains=2):
        assert [set(np.flatnonzero(step)) for step in row] == expected


# What a plan holds.

CONFIGS = {
    "gibbs": GibbsConfig(HORIZON, iterations=5, temperature=0.7, score=True),
    "shooting": ShootingConfig(HORIZON, candidates=6, score=True),
    "cross entropy": CrossEntropyConfig(HORIZON, iterations=5, candidates=6, elites=2, score=True),
    "beam": BeamConfig(HORIZON, 2, temperature=0.7, score=True),
}
EACH_PLANNER = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
SCORED = _gibbs(HORIZON, fill="confident", score=True, score_trace=True)


@pytest.mark.parametrize("config", [*CONFIGS.values(), SCORED], ids=[*CONFIGS, "scored trace"])
def test_a_plan_is_the_end_of_its_trace_with_its_exact_energy_and_a_function_of_its_key(config):
    plan = plans_of(ENUMERABLE, config, chains=50)
    iterations = getattr(config, "iterations", 1)
    assert plan.actions.shape == (50, HORIZON)
    assert plan.trace.shape == (50, iterations, HORIZON)
    assert plan.actions.dtype == plan.trace.dtype == np.int32
    assert ((plan.actions >= 0) & (plan.actions < ACTIONS)).all()
    np.testing.assert_array_equal(plan.trace[:, -1], plan.actions)
    np.testing.assert_allclose(plan.energy, joint_energies(plan.actions), rtol=1e-4)
    assert plan.satisfied.all() and plan.valid.all()
    assert (plan.trace_energies is None) != getattr(config, "score_trace", False)
    if plan.trace_energies is not None:
        np.testing.assert_array_equal(plan.trace_energies[:, -1], plan.energy)
        assert np.isposinf(plan.trace_energies[:, :-1]).all()  # what is not complete has none yet
    jax.tree.map(np.testing.assert_array_equal, plan, plans_of(ENUMERABLE, config, chains=50))
    other = plans_of(ENUMERABLE, config, chains=50, seed=1)
    assert (plan.actions != other.actions).any(-1).mean() > 0.2


@pytest.mark.parametrize("make", [GibbsConfig, ShootingConfig, CrossEntropyConfig, BeamConfig])
def test_energies_are_returned_only_if_asked_for(make):
    planner = bind(ENUMERABLE, make(HORIZON))
    plan = jax.eval_shape(lambda key: planner(TABLE, key, NO_TILT), jax.random.key(0))
    assert plan.energy is None and plan.trace_energies is None


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


@pytest.mark.parametrize(
    ("config", "rounds"),
    [
        (ShootingConfig(HORIZON, candidates=7), 1),
        (CrossEntropyConfig(HORIZON, 3, candidates=7, elites=2, keep_elites=False), 3),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_the_plan_is_the_best_candidate_of_the_last_round(config, rounds, seed):
    plan, scored = plan_and_scored(config, seed)
    assert len(scored) == rounds * 7
    energies = joint_energies(np.array(scored[-7:]))
    assert energies.min() < energies.max()
    assert tuple(np.asarray(plan.actions)) == scored[-7:][int(np.argmin(energies))]
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


@pytest.mark.parametrize("keep_elites", [True, False])
def test_kept_elites_never_let_the_best_energy_rise(keep_elites):
    config = CrossEntropyConfig(HORIZON, 8, candidates=5, elites=2, keep_elites=keep_elites)
    energies = joint_energies(plans_of(ENUMERABLE, config, chains=300).trace)
    rises = np.diff(energies, axis=1) > 1e-9
    # Without the elites it does rise, which shows that this can be seen.
    assert rises.any() != keep_elites
    assert (np.diff(energies, axis=1) < -0.1).any()


@pytest.mark.parametrize("forbidden", [0, 1, 2])
def test_a_child_differs_from_its_parent_in_one_token_that_is_possible(forbidden):
    """Where there is no other action that a plan can begin with, it is the same."""
    config = CrossEntropyConfig(HORIZON, 20, candidates=1, elites=1, keep_elites=False)
    context = NO_TILT.copy()
    context[0, 3 - forbidden :] = -np.inf
    trace = plans_of(ENUMERABLE, config, context=context, chains=200).trace
    assert set(np.unique(trace[..., 0])) == set(range(3 - forbidden))
    changed = trace[:, 1:] != trace[:, :-1]
    share = np.full(HORIZON, 1 / HORIZON)
    if forbidden < 2:
        assert (changed.sum(-1) == 1).all()
        assert fit_p_value(changed.sum((0, 1)), share) > ACCEPTED
    else:
        unchanged = (changed.sum(-1) == 0).sum()
        counts = [unchanged, changed[..., 1].sum(), changed[..., 2].sum()]
        assert fit_p_value(counts, share) > ACCEPTED
    shifts = ((trace[:, 1:] - trace[:, :-1]) % ACTIONS)[..., 1:][changed[..., 1:]]
    assert fit_p_value(np.bincount(shifts, minlength=ACTIONS), [0, 0.5, 0.5]) > ACCEPTED


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


@pytest.mark.parametrize("width", [1, 2, 40])
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
        found.append((plan.actions[0] == PLANS[joint.argmax()]).all())
    if width in (1, 40):
        assert all(found) == (width > 1)


@pytest.mark.parametrize("partial", [False, True])
@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_beam_search_keeps_no_plan_that_is_forbidden_while_another_is_allowed(partial, temperature):
    """A beam that leads into a dead end pays nothing there, and is the best by its sum."""

    def forbids_first(context, actions):  # known only once there is a second action
        return jnp.where((actions[0] != 2) & (actions[1] < ACTIONS), jnp.inf, 0.0)

    tilt = NO_TILT.copy()
    tilt[0, 2] = -5.0  # the only allowed beginning is the unlikeliest
    safe = constrain(ENUMERABLE, forbids_first, partial=partial)
    config = BeamConfig(HORIZON, 40, temperature, score=True)
    plan = plans_of(safe, config, np.zeros_like(TABLE), tilt, chains=100)
    assert (plan.actions[:, 0] == 2).all() and plan.satisfied.all() and plan.valid.all()
    np.testing.assert_array_equal(plan.actions, plan.trace[:, -1])
    assert np.isfinite(plan.energy).all()


def test_the_coldest_beam_is_a_greedy_one_and_enough_hot_ones_hold_the_likeliest_plan():
    greedy = plans_of(ENUMERABLE, BeamConfig(HORIZON, 1), chains=1)
    cold = plans_of(ENUMERABLE, BeamConfig(HORIZON, 1, 1e-30), chains=20)
    np.testing.assert_array_equal(cold.actions, np.repeat(greedy.actions, 20, axis=0))
    # As many as there are plans: all are drawn, in whatever order.
    hot = plans_of(ENUMERABLE, BeamConfig(HORIZON, 40, 1e30), chains=20)
    assert hot.valid.all() and (hot.actions == PLANS[JOINT.argmax()]).all()


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


@pytest.mark.parametrize("config", CONSTRAINED_CONFIGS.values(), ids=CONSTRAINED_CONFIGS)
def test_a_plan_that_breaks_a_constraint_is_never_called_satisfied(config):
    some = [(0, 0), (0, 1), (1, 1), (1, 2), (2, 0), (2, 2)]
    for price in (prices(*some, price=0.5), prices(*some), np.full_like(NO_TILT, np.inf)):
        plan = plans_of(CONSTRAINED, config, context={"tilt": NO_TILT, "price": price}, chains=300)
        broken = breaks(plan.actions, price)
        np.testing.assert_array_equal(plan.satisfied, ~broken)
        assert broken.any() and broken.all() == (price > 0).all()
        # No NaN either, and an infinite price makes an infinite energy.
        penalties = price[np.arange(HORIZON), plan.actions].sum(-1)
        np.testing.assert_allclose(plan.energy, joint_energies(plan.actions) + penalties, rtol=1e-4)
        if plan.trace_energies is not None:
            penalties = price[np.arange(HORIZON), plan.trace].sum(-1)
            expected = joint_energies(plan.trace) + penalties
            np.testing.assert_allclose(plan.trace_energies, expected, rtol=1e-4)


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
GIBBS = CONFIGS["gibbs"]


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


def check_rows(plan, expected):
    """Plans are the first of those that were made one by one."""
    expected = jax.tree.map(lambda leaf: leaf[: len(plan.actions)], expected)
    for name in ("actions", "trace", "satisfied"):
        np.testing.assert_array_equal(getattr(plan, name), getattr(expected, name))
    np.testing.assert_allclose(plan.energy, expected.energy, rtol=1e-5)


@EACH_PLANNER
def test_a_batch_is_a_loop_over_its_contexts(config):
    keys, contexts = batch_of(20)
    for batch in (1, 2, 7, 8, 9, 20):
        plan = batched(config)(TABLE, keys[:batch], {"tilt": contexts["tilt"][:batch]})
        check_rows(plan, one_by_one(config))


def test_plans_do_not_depend_on_how_many_devices_share_them():
    keys, contexts = batch_of(20)
    planner = compile_planner(TILTED, GIBBS, (8,), jax.devices()[:2])  # the others have all 8
    check_rows(planner(TABLE, keys, contexts), one_by_one(GIBBS))


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


@settings(max_examples=100, deadline=None)
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
    planner = compile_planner(TILTED, GIBBS, sizes)
    needed = {size for b in range(1, batch + 1) for _, size, _ in split_batch(b, sizes)}
    assert planner.sizes_up_to(batch) == sorted(needed)


def test_after_compiling_ahead_nothing_is_traced():
    traced = []

    def encode(params, context):
        traced.append(context)
        return ENUMERABLE.encode(params, context)

    planner = compile_planner(ENUMERABLE._replace(encode=encode), CONFIGS["gibbs"], (1, 4, 16))
    planner.compile(TABLE, NO_TILT, 20)
    before = len(traced)
    assert before
    for batch in (1, 3, 4, 15, 20):
        contexts = np.broadcast_to(NO_TILT, (batch, *NO_TILT.shape))
        planner(TABLE, jax.random.split(jax.random.key(0), batch), contexts)
    assert len(traced) == before
    with pytest.raises(UserError, match="batch must be at least 1"):
        planner.compile(TABLE, NO_TILT, 0)


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap])
def test_a_compiled_planner_inside_a_program_is_refused_in_one_line(transform):
    planner = compile_planner(ENUMERABLE, CONFIGS["gibbs"])
    keys = jax.random.split(jax.random.key(0), 2)[None]
    contexts = np.zeros((1, 2, *NO_TILT.shape), np.float32)
    with pytest.raises(UserError, match=r"inside of jit, vmap or grad.* use leap.gibbs"):
        transform(lambda keys, contexts: planner(TABLE, keys, contexts))(keys, contexts)


@pytest.mark.parametrize("name", ["conditional", "total", "violation"])
@pytest.mark.parametrize(
    "config",
    [
        GibbsConfig(HORIZON, score=True),
        ShootingConfig(HORIZON),
        CrossEntropyConfig(HORIZON),
        BeamConfig(HORIZON, score=True),
    ],
)
def test_an_energy_of_another_shape_is_refused(name, config):
    wrong = ENUMERABLE._replace(**{name: lambda *given: jnp.zeros((2, 7))})
    with pytest.raises(UserError, match=rf"^{name} of the energy must be .*, got shape \(2, 7\)"):
        jax.eval_shape(bind(wrong, config), TABLE, jax.random.key(0), NO_TILT)


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
    with jax.default_prng_impl("rbg"):
        np.testing.assert_array_equal(plan_keys(7, episodes, replans), data)


def test_parameters_are_an_argument_and_their_place_in_the_tree_matters():
    keys, contexts = batch_of(8)
    table = jnp.asarray(TABLE)
    either = TILTED._replace(
        encode=lambda p, c: TILTED.encode(-p["b"] if p["a"] is None else p["a"], c)
    )
    planner = compile_planner(either, GIBBS, (8,))
    for params, same in (({"a": table, "b": None}, table), ({"a": None, "b": table}, -table)):
        expected = batched(GIBBS)(same, keys, contexts).actions
        np.testing.assert_array_equal(planner(params, keys, contexts).actions, expected)


def test_parameters_are_placed_again_only_when_they_change():
    keys, contexts = batch_of(8)
    planner = batched(GIBBS)
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


@only_long
@settings(max_examples=12, deadline=None)
@given(st.integers(1, 4), st.integers(1, 4), st.integers(1, 9), st.sampled_from(list(CONFIGS)))
def test_plans_of_any_shape(horizon, actions, batch, name):
    config = dataclasses.replace(CONFIGS[name], horizon=horizon)
    planner = compile_planner(enumerable_energy(horizon, actions), config, (4,), jax.devices()[:1])
    table = random_table(0, horizon, actions)
    tilts = np.zeros((batch, horizon, actions), np.float32)
    keys = plan_keys(1, np.arange(batch), np.zeros(batch, int))
    plan = planner(table, keys, tilts)
    assert plan.actions.shape == (batch, horizon)
    np.testing.assert_array_equal(plan.trace[:, -1], plan.actions)
    assert ((plan.actions >= 0) & (plan.actions < actions)).all()
    jax.tree.map(np.testing.assert_array_equal, plan, planner(table, keys, tilts))


# Energies that are no numbers. Parameters: a table, and what stands where an energy should be.

UNDEFINED_TOTAL = ENUMERABLE._replace(
    encode=lambda params, context: ENUMERABLE.encode(params[0], context),
    total=lambda params, memory, actions: params[1],
)


def _undefined_at_first(params, memory, actions, positions):
    energies = ENUMERABLE.conditional(params[0], memory, actions, positions)
    return jnp.where(jnp.all(actions == ACTIONS), energies.at[0, 1].set(params[1]), energies)


UNDEFINED_STEP = UNDEFINED_TOTAL._replace(conditional=_undefined_at_first)


@pytest.mark.parametrize(
    ("energy", "config"),
    [
        (UNDEFINED_STEP, GibbsConfig(HORIZON, 3)),
        (UNDEFINED_TOTAL, GibbsConfig(HORIZON, 3, score=True)),
        (UNDEFINED_TOTAL, GibbsConfig(HORIZON, 3, score_trace=True)),
        (UNDEFINED_TOTAL, GibbsConfig(HORIZON, 3, restarts=2)),
        (UNDEFINED_TOTAL, ShootingConfig(HORIZON)),
        (UNDEFINED_TOTAL, CrossEntropyConfig(HORIZON)),
        (UNDEFINED_TOTAL, BeamConfig(HORIZON, score=True)),
    ],
)
def test_a_plan_whose_energy_is_no_number_is_not_valid(energy, config):
    for value, valid in ((np.nan, False), (-np.inf, False), (1.0, True)):
        plan = plans_of(energy, config, (TABLE, np.float32(value)), chains=2)
        assert (plan.valid == valid).all()


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


# What a planner takes, and mistakes.

KEYS, CONTEXTS = batch_of(2)


@pytest.mark.parametrize(
    ("keys", "more"),
    [
        (jax.random.wrap_key_data(KEYS), {}),
        ([*KEYS], {}),
        (KEYS, {str(kind): np.zeros(2, kind) for kind in (jnp.bfloat16, np.uint64, bool)}),
    ],
)
def test_keys_and_contexts_of_every_type_are_taken(keys, more):
    expected = batched(GIBBS)(TABLE, KEYS, CONTEXTS)
    plan = batched(GIBBS)(TABLE, keys, {**CONTEXTS, **more})
    jax.tree.map(np.testing.assert_array_equal, plan, expected)


NOT_ONE_EACH = "expected one for each context"
RAW = r"raw keys must be \[B, 2\] uint32"
WRONG_SHAPE = r"context\['tilt'\] has shape .* number of keys, 2"


def _tilt(*shape):
    return {"tilt": np.zeros(shape, np.float32)}


@pytest.mark.parametrize(
    ("keys", "contexts", "message"),
    [
        (KEYS[0], CONTEXTS, NOT_ONE_EACH),
        (jax.random.key(0), CONTEXTS, NOT_ONE_EACH),
        (jax.random.wrap_key_data(KEYS)[None], CONTEXTS, NOT_ONE_EACH),
        (KEYS.astype(np.int64), CONTEXTS, RAW),
        (KEYS[:, :1], CONTEXTS, RAW),
        (5, CONTEXTS, "keys must be an array"),
        ("keys", CONTEXTS, "keys must be an array"),
        (KEYS[:0], _tilt(0, HORIZON, ACTIONS), "no contexts"),
        (KEYS, _tilt(3, HORIZON, ACTIONS), WRONG_SHAPE),
        (KEYS, _tilt(), WRONG_SHAPE),
        (
            KEYS,
            {**CONTEXTS, "mission": np.array(["go", "stay"])},
            r"context\['mission'\] holds <U\d+, not numbers",
        ),
    ],
)
def test_keys_and_contexts_that_do_not_fit_are_refused(keys, contexts, message):
    with pytest.raises(ValueError, match=message):
        batched(GIBBS)(TABLE, keys, contexts)


@pytest.mark.parametrize(
    "wide", [np.array([0, 2**31]), np.array([0, 2**32], np.uint64), np.array([np.inf, -1e39])]
)
def test_numbers_that_jax_would_change_are_refused(wide):
    with pytest.raises(UserError, match=r"context\['more'\]\[0\] holds .*does not fit"):
        batched(GIBBS)(TABLE, KEYS, {**CONTEXTS, "more": [wide]})
    with pytest.raises(UserError, match=r"params\['more'\] holds .*does not fit"):
        batched(GIBBS)({"table": TABLE, "more": wide}, KEYS, CONTEXTS)


def test_numbers_of_64_bits_that_fit_are_taken():
    for fits in (
        [2**31 - 1, -(2**31)], np.array([2**32 - 1], np.uint64), [np.nan, np.inf, -np.inf, 3e38],
        [1 / 3], [], np.array([2**32 - 1], np.uint32), jnp.array([1]), ["words are not numbers"],
    ):  # fmt: skip
        check_fit("context", {"x": fits if isinstance(fits, jax.Array) else np.array(fits)})


@pytest.mark.parametrize("edge", ["seed", "episode", "replan"])
def test_keys_of_other_numbers_than_seeds_are_refused(edge):
    for wrong in (-1, 2**32, 5.9, np.nan):
        arguments = {"seed": 0, "episode": np.array([0]), "replan": np.array([0])}
        arguments[edge] = wrong if edge == "seed" else np.array([wrong])
        with pytest.raises(UserError, match=edge + " must be"):
            plan_keys(*arguments.values())
    with pytest.raises(UserError, match="2 episodes, but 1 replans"):
        plan_keys(0, np.arange(2), np.arange(1))


WRONG = [
    *(
        (lambda sizes=sizes: compile_planner(TILTED, GIBBS, sizes), "chunk sizes")
        for sizes in ((), (8, -1), (4.0,), (True,), 8, "8", (2**31,))
    ),
    (lambda: compile_planner(TILTED, GIBBS, (1,), "cpu"), "devices must be a sequence"),
    (lambda: compile_planner(TILTED, GIBBS, (1,), ["cpu"]), "devices must be a sequence"),
    (lambda: plans_of(FROM_TOTAL, _gibbs(fill="margin")), "fill 'margin' .* use fill 'together'"),
    (lambda: plans_of(FROM_TOTAL, BeamConfig(HORIZON)), "accepts_mask is False"),
    (lambda: GibbsConfig(0), "horizon must be at least 1, got 0"),
    (lambda: GibbsConfig(3, 0), "iterations must be at least 1, got 0"),
    (lambda: GibbsConfig(3, resampled=0), "resampled must be at least 1, got 0"),
    (lambda: GibbsConfig(3, restarts=-1), "restarts must be at least 1, got -1"),
    (lambda: GibbsConfig(3, resampled=4), "resampled is 4, .* the horizon 3"),
    (lambda: GibbsConfig(3, order="backwards"), "unknown order 'backwards': .*sequential"),
    (lambda: GibbsConfig(3, fill="at once"), "unknown fill 'at once': .*confident"),
    (lambda: GibbsConfig(5, 2, 2, fill="margin"), "needs 3"),
    (lambda: ShootingConfig(candidates=0), "candidates must be at least 1, got 0"),
    (lambda: CrossEntropyConfig(elites=0), "elites must be at least 1"),
    (lambda: CrossEntropyConfig(candidates=2, elites=3), "3 elites out of 2 candidates"),
    (lambda: BeamConfig(beams=0), "beams must be at least 1"),
    (lambda: BeamConfig(temperature=-1.0), "a temperature must be in"),
    *(
        (lambda t=t: GibbsConfig(temperature=t), "temperature must be")
        for t in (-0.1, 1e31, float("nan"), "1", None, True)
    ),
]


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_impossible_configurations_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
    with pytest.raises(TypeError, match="no planner takes a dict"):
        bind(ENUMERABLE, {"horizon": 3})
