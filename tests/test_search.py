"""Search with an energy: positions by certainty, beams in any order, dead ends, local terms."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from leapjax import (
    BeamConfig,
    Energy,
    Factors,
    GibbsConfig,
    compose,
    constrain,
    from_factors,
    from_total,
)
from leapjax.energy import symmetric
from leapjax.errors import UserError
from leapjax.planners import (
    FILLS,
    CrossEntropyConfig,
    ShootingConfig,
    beam_search,
    bind,
    cross_entropy_method,
    gibbs,
    random_shooting,
)
from leapjax.planners.judges import SPLITS, sum_halves
from leapjax.planners.positions import Commitment, choose_open, most_certain
from leapjax.types import Turned, mask_token
from tests.enumerable import (
    all_plans,
    conditional_by_counting,
    enumerable_energy,
    fit_p_value,
    joint_probabilities,
    plan_counts,
    random_table,
)
from tests.programs import only_long
from tests.quick import many_plans, quick_jit

HORIZON, ACTIONS = 3, 3
PLANS = all_plans(HORIZON, ACTIONS)
ENUMERABLE = enumerable_energy(HORIZON, ACTIONS)
NO_TILT = np.zeros((HORIZON, ACTIONS), np.float32)
assert_equal = np.testing.assert_array_equal
assert_close = np.testing.assert_allclose


CONFIGS = [
    GibbsConfig(HORIZON, 1),
    ShootingConfig(HORIZON, 5),
    CrossEntropyConfig(HORIZON, 2, 5),
    BeamConfig(HORIZON, 4),
]


@functools.cache
def compile_one(energy, config):
    return quick_jit(bind(energy, config))


def plan_for(config, energy=ENUMERABLE, params=None, context=NO_TILT, chains=None, seed=0):
    """Makes a plan with one key, or plans with `chains` keys."""
    key = jax.random.key(seed)
    if chains is None:
        return jax.tree.map(np.asarray, compile_one(energy, config)(params, key, context))
    plans = many_plans(energy, config)(params, jax.random.split(key, chains), context)
    return jax.tree.map(np.asarray, plans)


# How many positions a pass fills.


def count_by_hand(probabilities, least, certainty, entropy):
    """Counts how many ranked positions a pass fills, by the definitions."""
    with np.errstate(divide="ignore", invalid="ignore"):
        entropies = -np.nansum(probabilities * np.log(probabilities), axis=1)
    count = least
    while count < len(probabilities):
        following = probabilities[: count + 1]
        certain = certainty < 1 and (following.max(1) >= certainty).all()
        spread = entropies[: count + 1].sum() - entropies[: count + 1].max()
        if not (certain or (entropy > 0 and spread <= entropy)):
            break
        count += 1
    return count


@pytest.mark.parametrize(
    ("least", "certainty", "entropy"),
    [(1, 0.7, 0.0), (1, 1.0, 0.9), (2, 0.6, 0.3), (1, 0.0, 0.0), (2, 1.0, 0.0)],
)
def test_a_pass_fills_the_certain_positions(least, certainty, entropy):
    rng, counts = np.random.default_rng(0), set()
    for _ in range(30):
        logits = rng.normal(scale=3, size=(8, 4)).astype(np.float32)
        open_ = rng.random(8) < 0.7
        open_[:2] = True
        energies = -jax.nn.log_softmax(jnp.array(logits))
        ranks = most_certain(energies, None)
        commitment = Commitment(least, certainty, entropy)
        where, chosen = map(np.asarray, choose_open(energies, jnp.array(open_), ranks, commitment))
        probabilities = np.exp(-np.asarray(energies, np.float64))
        ranked = sorted(np.flatnonzero(open_), key=lambda t: -probabilities[t].max())
        count = count_by_hand(probabilities[ranked], least, certainty, entropy)
        assert where[chosen].tolist() == ranked[:count]
        counts.add(count)
    assert len(counts) > 2 or not commitment.adapts


@pytest.mark.parametrize("bound", [{"certainty": 0.8}, {"entropy_bound": 0.3}])
@pytest.mark.parametrize("kind", [GibbsConfig, BeamConfig])
def test_certain_positions_save_passes(kind, bound):
    """`passes` agrees with the trace; without a bound, each pass fills one position."""
    counts = set()
    for seed in range(12):
        table = 2 * random_table(seed, HORIZON, ACTIONS)
        size = {"iterations": HORIZON} if kind is GibbsConfig else {"beams": 2}
        plain = plan_for(kind(HORIZON, **size, fill="confident"), params=table)
        quick = plan_for(kind(HORIZON, **size, fill="confident", **bound), params=table)
        beams = size.get("beams", 1)
        assert plain.passes == beams * HORIZON
        assert quick.passes % beams == 0 and quick.passes <= plain.passes
        assert (quick.actions < ACTIONS).all()
        assert (quick.trace[quick.passes // beams - 1 :] == quick.actions).all()
        if kind is GibbsConfig:
            filled = (quick.trace < ACTIONS).sum(1)
            assert (np.diff(filled[: quick.passes]) > 0).all()
        counts.add(int(quick.passes))
    assert len(counts) > 1


def test_independent_positions_are_drawn_from_their_joint_in_one_pass():
    """The entropy bound limits dependence between actions; these actions are independent."""
    rows = np.random.default_rng(0).normal(size=(HORIZON, ACTIONS))
    table = (rows[0][:, None, None] + rows[1][:, None] + rows[2]).astype(np.float32)
    config = GibbsConfig(HORIZON, HORIZON, fill="confident", temperature=1.0, entropy_bound=9.0)
    plan = plan_for(config, params=table, chains=5000)
    assert (plan.passes == 1).all()
    counts = plan_counts(plan.actions, ACTIONS)
    assert fit_p_value(counts, joint_probabilities(table).reshape(-1)) > 1e-3


@pytest.mark.parametrize("rank", [np.nan, -np.inf, np.inf, 3, True])
def test_ranks_of_any_type_fill_the_plan(rank):
    config = GibbsConfig(HORIZON, HORIZON, fill=lambda energies, key: jnp.full(HORIZON, rank))
    plan = plan_for(config, params=random_table(0, HORIZON, ACTIONS))
    assert (plan.actions < ACTIONS).all() and plan.passes == HORIZON


# Kept plans, cooling, and the number of passes.


def test_keep_best_returns_the_best_plan_of_all_traces():
    table = random_table(3, HORIZON, ACTIONS)
    options = {"temperature": 1.5, "restarts": 2, "score": True, "score_trace": True}
    last = plan_for(GibbsConfig(HORIZON, 8, **options), params=table, chains=200)
    best = plan_for(GibbsConfig(HORIZON, 8, keep="best", **options), params=table, chains=200)
    assert_close(best.energy, best.trace_energies.min(1), rtol=1e-5)
    assert (best.energy <= last.energy + 1e-5).all() and (best.energy < last.energy - 0.1).any()
    energies = -np.log(joint_probabilities(table))[tuple(best.actions.T)]
    assert_close(best.energy, energies, rtol=1e-4)


def test_cooling_lowers_the_energy_unless_the_temperature_stays():
    table = random_table(0, HORIZON, ACTIONS)
    plain = plan_for(GibbsConfig(HORIZON, 9, temperature=0.7), params=table, chains=50)
    same = plan_for(GibbsConfig(HORIZON, 9, temperature=0.7, cool_to=0.7), params=table, chains=50)
    assert_equal(plain.trace, same.trace)
    cooled = GibbsConfig(HORIZON, 30, temperature=2.0, cool_to=0.0)
    energy = -np.log(joint_probabilities(table))
    found, warm = (
        energy[tuple(plan_for(each, params=table, chains=500).actions.T)].mean()
        for each in (cooled, GibbsConfig(HORIZON, 30, temperature=2.0))
    )
    assert found < warm - 0.5


def test_passes_count_every_conditional_and_every_total():
    table = random_table(0, HORIZON, ACTIONS)
    for config, expected in (
        (GibbsConfig(HORIZON, 7), 7),
        (GibbsConfig(HORIZON, 7, score=True), 7 + HORIZON),
        (GibbsConfig(HORIZON, 7, restarts=4, score=True), 4 * (7 + HORIZON)),
        (GibbsConfig(HORIZON, 7, keep="best", score_trace=True), 7 + 7 * HORIZON),
        (GibbsConfig(HORIZON, 7, fill="margin", keep="best"), 7 + (8 - HORIZON) * HORIZON),
        (GibbsConfig(HORIZON, 7, restarts=4, judge="halves"), 4 * (7 + 2 * SPLITS)),
        (BeamConfig(HORIZON, 4, judge="energy", score=True), 8 * HORIZON),
        (BeamConfig(HORIZON, 4, judge="halves"), 4 * HORIZON + 4 * 2 * SPLITS),
        (ShootingConfig(HORIZON, 5), 1 + 5 * HORIZON),
        (CrossEntropyConfig(HORIZON, 2, 5), 1 + 2 * 5 * HORIZON),
    ):
        assert plan_for(config, params=table).passes == expected, config


# Judges and restarts.


def test_judge_halves_sums_conditionals_given_the_other_half():
    horizon, actions = 4, 2
    energy = enumerable_energy(horizon, actions)
    table, tilt = random_table(2, horizon, actions), np.zeros((horizon, actions), np.float32)
    joint, memory = joint_probabilities(table), energy.encode(table, tilt)
    halves = [set(half) for half in itertools.combinations(range(horizon), horizon // 2)]

    def cost(plan, hidden):
        tokens = np.where(np.isin(np.arange(horizon), [*hidden]), actions, plan)
        return -sum(np.log(conditional_by_counting(joint, tokens, t)[plan[t]]) for t in hidden)

    score_plan, found = quick_jit(functools.partial(sum_halves, energy, table, memory)), set()
    for seed, plan in itertools.product(range(4), all_plans(horizon, actions)[[0, 5, 14]]):
        score = float(score_plan(jax.random.key(seed), plan))
        splits = [cost(plan, half) + cost(plan, {*range(horizon)} - half) for half in halves]
        sums = [sum(each) for each in itertools.product(splits, repeat=SPLITS)]
        assert np.isclose(sums, score, rtol=1e-4).any()
        found.add(round(score, 4))
    assert len(found) > 3  # keys draw different halves


def test_judge_halves_forbids_actions_that_the_energy_forbids():
    forbidden = from_total(lambda params, context: None, None, 3)._replace(
        conditional=lambda params, memory, actions, positions: (
            jnp.full((positions.shape[0], 3), 1.0).at[:, 2].set(jnp.inf)
        ),
        accepts_mask=True,
    )
    for plan, expected in (([0, 1, 0], SPLITS * 3 * np.log(2)), ([0, 2, 0], np.inf)):
        score = sum_halves(forbidden, None, None, jax.random.key(0), jnp.array(plan))
        assert_close(score, expected, rtol=1e-5)


@pytest.mark.parametrize("judge", ["energy", "halves"])
def test_best_of_the_trace_is_complete_if_every_plan_is_forbidden(judge):
    energy = constrain(ENUMERABLE, lambda context, plan: jnp.inf)
    config = GibbsConfig(HORIZON, HORIZON + 2, fill="margin", keep="best", judge=judge, score=True)
    plan = plan_for(
        dataclasses.replace(config, score_trace=True), energy, params=random_table(0, HORIZON, 3)
    )
    assert (plan.actions < ACTIONS).all() and not plan.satisfied and plan.valid
    assert plan.trace_energies.shape == (HORIZON + 2,) and np.isposinf(plan.energy)


def test_judge_halves_takes_an_allowed_plan():
    """One pass ignores the penalty of complete plans, so restarts draw both kinds of plans."""
    table = random_table(0, HORIZON, ACTIONS)
    likely = np.unravel_index(joint_probabilities(table).argmax(), (ACTIONS,) * HORIZON)
    energy = constrain(ENUMERABLE, lambda context, plan: 9.0 * (plan[0] == likely[0]))
    config = GibbsConfig(HORIZON, 1, temperature=1.0, restarts=16, judge="halves")
    assert plan_for(config, energy, params=table, chains=20).satisfied.all()
    assert not plan_for(
        dataclasses.replace(config, restarts=1), energy, table, chains=20
    ).satisfied.all()


def test_judge_halves_never_keeps_an_unfinished_plan():
    """The best of a trace is complete, although the last action, which MASK follows, is cheap."""

    def conditional(params, memory, actions, positions):
        open_ = (actions == 3).sum()  # every action costs more when fewer are open
        return jnp.tile(jnp.array([1.0, 1.0, -8.0]) * open_, (positions.shape[0], 1))

    energy = from_total(lambda params, context: (), lambda *inputs: 0.0, 3)
    energy = energy._replace(conditional=conditional, accepts_mask=True)
    config = GibbsConfig(HORIZON, HORIZON, fill="confident", keep="best", judge="halves")
    assert (plan_for(config, energy, chains=20).actions < 3).all()
    unfinished = jnp.array([3, 0, 3])
    assert np.isposinf(sum_halves(energy, None, (), jax.random.key(0), unfinished))


def mislead():
    """Makes an energy that begins plans with a wrong action, unless the context is turned.

    The context is the right plan: three different actions. At position 0, the energy prefers
    action 0 if all other positions are masked, else the right action.
    """

    def conditional(params, memory, actions, positions):
        def score(position):
            alone = (actions == 3) | (jnp.arange(3) == position)
            right = jnp.where((position == 0) & alone.all(), 0, memory[position])
            return 4.0 * (jnp.arange(3) != right)

        return jax.vmap(score)(positions)

    def total(params, memory, actions):
        return 4.0 * (actions != memory).sum()

    return Energy(lambda params, context: jnp.asarray(context), conditional, total, 3)


def permute(key, context):
    """Turns a context of three different numbers: permutes its places and its names."""
    place_key, name_key = jax.random.split(key)
    places = jax.random.permutation(place_key, 3)
    names = jax.random.permutation(name_key, 3)
    return Turned(names[context[places]], places, jnp.tile(names, (3, 1)))


TURNED = symmetric(mislead(), permute)


def test_a_turned_energy_equals_the_energy_of_the_renamed_plan():
    context, inner = jnp.array([2, 0, 1]), mislead()
    rng = np.random.default_rng(0)
    for seed in range(5):
        key = jax.random.key(seed)
        turned, memory = permute(key, context), TURNED.turn((), key, TURNED.encode((), context))
        places, names = np.asarray(turned.places), np.asarray(turned.names[0])
        plan = rng.integers(0, 4, 3)  # 3 is MASK
        renamed = np.append(names, 3)[plan[places]]
        expected = inner.conditional((), turned.context, jnp.asarray(renamed), jnp.arange(3))
        found = TURNED.conditional((), memory, jnp.asarray(plan), jnp.arange(3))
        for index, (position, action) in enumerate(itertools.product(range(3), repeat=2)):
            other = expected[np.flatnonzero(places == position)[0], names[action]]
            assert found[index // 3, action] == other
        complete = jnp.asarray(rng.integers(0, 3, 3))
        expected = inner.total((), turned.context, jnp.asarray(names)[complete[places]])
        assert_close(TURNED.total((), memory, complete), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("judge", "enough"),
    [
        ("energy", None), ("halves", 0.5),
        pytest.param("energy", 0.5, marks=only_long), pytest.param("halves", None, marks=only_long),
    ],
)  # fmt: skip
def test_restarts_turn_the_context(judge, enough):
    context = jnp.array([2, 0, 1])  # without turns, the energy chooses 0 at position 0
    options = {"fill": "confident", "judge": judge, "score": True}
    alone = GibbsConfig(3, 3, **options)
    assert plan_for(alone, TURNED, context=context).actions[0] == 0
    many = GibbsConfig(3, 3, restarts=24, enough=enough, **options)
    unturned = plan_for(many, mislead(), context=context)
    assert unturned.actions[0] == 0
    plan = plan_for(many, TURNED, context=context)
    assert_equal(plan.actions, context)
    # The reported energy is the energy in the original context.
    assert_close(plan.energy, mislead().total((), context, jnp.asarray(plan.actions)), rtol=1e-6)


def test_a_symmetry_that_does_not_fit_the_plan_raises_an_error():
    form = TURNED.turn((), jax.random.key(0), TURNED.encode((), jnp.array([2, 0, 1])))
    with pytest.raises(UserError, match="a plan of 4 actions, and a symmetry of plans of 3"):
        TURNED.conditional((), form, jnp.zeros(4, int), jnp.arange(4))
    wrong = symmetric(mislead(), lambda key, context: context)
    with pytest.raises(UserError, match="Turned"):
        wrong.turn((), jax.random.key(0), wrong.encode((), jnp.array([2, 0, 1])))


def test_composed_and_constrained_energies_turn_their_parts():
    context = jnp.array([2, 0, 1])
    both = compose([TURNED, mislead()], [1.0, 0.5])
    bound = constrain(both, lambda context, plan: jnp.where(plan[0] == 1, 1.0, 0.0))
    key = jax.random.key(3)
    memory, _ = bound.turn(((), ()), key, bound.encode(((), ()), context))
    assert memory[1] is not None and memory[0].places is not None
    expected = TURNED.turn((), key, TURNED.encode((), context))
    assert_equal(memory[0].places, expected.places)
    assert_equal(memory[1], context)  # the other part has no symmetry


def test_restarts_stop_when_a_plan_is_good_enough():
    table = random_table(1, HORIZON, ACTIONS)
    options = {"temperature": 1.0, "restarts": 8, "score": True}
    all_ = plan_for(GibbsConfig(HORIZON, 4, **options), params=table, chains=300)
    never = plan_for(GibbsConfig(HORIZON, 4, enough=-1.0, **options), params=table, chains=300)
    assert_equal(never.actions, all_.actions)
    assert_equal(never.passes, all_.passes)
    enough = 1e-3 - np.log(joint_probabilities(table).max())
    some = plan_for(GibbsConfig(HORIZON, 4, enough=enough, **options), params=table, chains=300)
    stopped = some.passes < all_.passes
    assert stopped.any() and not stopped.all()
    assert (some.energy[stopped] <= enough).all() and (
        some.energy[~stopped] >= all_.energy.min()
    ).all()
    one = 4 + HORIZON  # passes of a restart and its judge
    assert (some.passes % one == 0).all() and (some.passes >= one).all()
    assert (
        some.energy[some.passes == all_.passes] == all_.energy[some.passes == all_.passes]
    ).all()


# Beams in any order.


@pytest.mark.parametrize("fill", [fill for fill in FILLS if fill != "together"])
@pytest.mark.parametrize("judge", ["sum", "energy"])
def test_wide_beams_find_the_mode_in_any_order(fill, judge):
    for seed in range(6):
        table = random_table(seed, HORIZON, ACTIONS)
        config = BeamConfig(HORIZON, ACTIONS ** (HORIZON - 1), fill=fill, judge=judge, score=True)
        plan = plan_for(config, params=table)
        joint = joint_probabilities(table)
        assert_equal(plan.actions, np.unravel_index(joint.argmax(), joint.shape))
        assert_close(plan.energy, -np.log(joint.max()), rtol=1e-4)


def test_judge_halves_chooses_among_beams_of_all_plans():
    table, key = random_table(4, HORIZON, ACTIONS), jax.random.key(0)
    memory = ENUMERABLE.encode(table, NO_TILT)
    judge_key = jax.random.fold_in(key, 2)
    score = functools.partial(sum_halves, ENUMERABLE, table, memory, judge_key)
    scores = quick_jit(jax.vmap(score))(PLANS)
    plan = plan_for(BeamConfig(HORIZON, len(PLANS), judge="halves"), params=table)
    assert_equal(plan.actions, PLANS[np.argmin(scores)])


@pytest.mark.parametrize("fill", ["together", "sequential"])
def test_no_action_stays_masked_if_all_are_forbidden(fill):
    def forbid(params, memory, actions, positions):
        return jnp.full((positions.shape[0], 3), jnp.inf)

    energy = Energy(lambda params, context: None, forbid, lambda *inputs: jnp.inf, 3)
    assert (plan_for(GibbsConfig(3, 3, fill=fill), energy).actions < 3).all()


def test_judges_energy_and_sum_choose_different_beams():
    """The conditionals of this pseudo-likelihood belong to no joint distribution."""

    def conditional(params, memory, actions, positions):
        first = jnp.array([0.0, 0.1, 5.0])  # action 0 costs least at first
        second = jnp.where(actions[0] == 0, 2.0, 2.1) + jnp.zeros(3)
        return jnp.where(positions[:, None] == 0, first, second)

    def total(params, memory, actions):  # action 0 has the higher total
        return jnp.where(actions[0] == 0, 9.0, 1.0)

    energy = Energy(lambda params, context: None, conditional, total, 3)
    by_sum = plan_for(BeamConfig(2, 4), energy)
    by_energy = plan_for(BeamConfig(2, 4, judge="energy"), energy)
    assert by_sum.actions[0] == 0 and by_energy.actions[0] == 1


# Dead ends.


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    allowed=st.lists(st.integers(0, 26), min_size=1, max_size=4),
    partial=st.booleans(),
    fill=st.sampled_from(["sequential", "confident", "random"]),
)
def test_wide_beams_find_the_best_allowed_plan(seed, allowed, partial, fill):
    """Forbidden plans may cost less."""
    plans = PLANS[sorted(set(allowed))]
    context = np.zeros(len(PLANS), np.float32)
    context[sorted(set(allowed))] = 1
    plan = PLANNERS[partial, fill](2 * random_table(seed, HORIZON, ACTIONS), context)
    joint = joint_probabilities(2 * random_table(seed, HORIZON, ACTIONS))[tuple(plans.T)]
    assert plan.satisfied
    assert_equal(plan.actions, plans[joint.argmax()])


def _penalise(context, plan):
    """Returns 0 if a plan can still become an allowed plan, else +inf."""
    agrees = ((jnp.array(PLANS) == plan) | (plan == ACTIONS)).all(1)
    return jnp.where((agrees & (context > 0)).any(), 0.0, jnp.inf)


def _make_planner(partial, fill):
    energy = constrain(
        ENUMERABLE._replace(
            encode=lambda p, c: ENUMERABLE.encode(p, jnp.zeros((HORIZON, ACTIONS)))
        ),
        _penalise,
        partial=partial,
    )
    planner = quick_jit(bind(energy, BeamConfig(HORIZON, ACTIONS ** (HORIZON - 1), fill=fill)))
    return lambda table, context: jax.tree.map(
        np.asarray, planner(table, jax.random.key(0), context)
    )


PLANNERS = {
    (partial, fill): _make_planner(partial, fill)
    for partial in (False, True)
    for fill in ("sequential", "confident", "random")
}


@pytest.mark.parametrize("options", [{}, {"temperature": 1.0}, {"judge": "energy", "score": True}])
def test_beams_of_probability_0_may_have_undefined_energies(options):
    def conditional(params, memory, actions, positions):
        first = jnp.array([jnp.inf, 1.0, 2.0])
        second = jnp.where(actions[0] == 0, jnp.nan, jnp.arange(3.0))
        return jnp.where(positions[:, None] == 0, first, second)

    def total(params, memory, actions):
        return jnp.where(actions[0] == 0, jnp.nan, (actions + 1.0).sum())

    energy = Energy(lambda params, context: None, conditional, total, 3)
    plan = plan_for(BeamConfig(2, 9, **options), energy)
    assert plan.valid and (options.get("temperature") or plan.actions.tolist() == [1, 0])
    hopeless = energy._replace(conditional=lambda *query: conditional(*query) + jnp.nan)
    assert not plan_for(BeamConfig(2, 9, **options), hopeless).valid


@pytest.mark.parametrize(
    ("config", "penalty"),
    [*((config, np.nan) for config in CONFIGS), (GibbsConfig(HORIZON, 2), -np.inf)],
)
def test_undefined_penalties_make_a_plan_invalid(config, penalty):
    energy = constrain(ENUMERABLE, lambda context, plan: penalty)
    assert not plan_for(config, energy, params=random_table(0, HORIZON, ACTIONS)).valid


# Energies of local terms.

EDGES = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (4, 4)], np.int32)
WEIGHTS = np.array([1.0, 2.0, 0.5, 3.0, 1.5, 0.25], np.float32)


def _clash(params, weight, actions):
    return params * weight * (actions[0] == actions[1]) + 0.1 * actions[1]


COLOURING = from_factors(lambda params, context: Factors(context, WEIGHTS), _clash, 3, degree=3)


def _sum_clashes(params, memory, actions):
    pairs = actions[memory]
    return (params * WEIGHTS * (pairs[:, 0] == pairs[:, 1]) + 0.1 * pairs[:, 1]).sum()


def test_local_terms_have_the_same_energies_as_their_sum():
    def evaluate(energy, plan):
        memory = energy.encode(2.0, EDGES)
        energies = energy.conditional(2.0, memory, plan, jnp.arange(5))
        return energy.total(2.0, memory, plan), energies - energies[:, :1]

    whole = from_total(lambda params, context: context, _sum_clashes, 3)
    plans = np.array(list(itertools.product(range(3), repeat=5)))
    for local, exact in zip(
        *(
            quick_jit(jax.vmap(functools.partial(evaluate, energy)))(plans)
            for energy in (COLOURING, whole)
        ),
        strict=True,
    ):
        assert_close(local, exact, atol=1e-5)


def test_local_terms_may_score_incomplete_plans():
    """A pair with an open end costs 0, so the conditional counts only chosen neighbours."""

    def clash(params, weight, actions):
        both = (actions < 3).all()
        return jnp.where(both, weight * (actions[0] == actions[1]), 0.0)

    energy = from_factors(
        lambda params, context: Factors(EDGES, WEIGHTS), clash, 3, degree=3, accepts_mask=True
    )
    memory, mask = energy.encode(None, None), mask_token(3)
    plan = jnp.array([mask, 1, 2, mask, mask])
    query = quick_jit(functools.partial(energy.conditional, None, memory, plan))
    assert_close(query(jnp.array([0]))[0], [0, 1.0, 1.5])
    assert_close(query(jnp.array([0, 1]))[0], [0, 0, 1.5])
    assert np.isposinf(energy.total(None, memory, plan))
    found = plan_for(GibbsConfig(5, 5, fill="confident"), energy)
    pairs = found.actions[EDGES[:5]]
    assert (pairs[:, 0] != pairs[:, 1]).all()


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        (np.append(EDGES[:5], [[0, 4]], axis=0), "4 terms read position 0, and degree is 3"),
        (EDGES - 1, r"positions of factors .* are not all in 0 \.\. 4"),
        (EDGES + 1, r"positions of factors .* are not all in 0 \.\. 4"),
        (EDGES[0], r"integers of shape \[terms, positions of a term\], got int32\[2\]"),
        (EDGES * 1.0, "must be integers of shape"),
    ],
)
def test_positions_of_terms_that_do_not_fit_raise_an_error(edges, message):
    memory, plan = COLOURING.encode(1.0, edges), jnp.zeros(5, int)
    for query in (
        lambda: COLOURING.conditional(1.0, memory, plan, jnp.array([0])),
        lambda: COLOURING.total(1.0, memory, plan),
    ):
        with pytest.raises(ValueError, match=message):
            query()
    if edges.shape == EDGES.shape and edges.dtype == EDGES.dtype:  # values that `jit` does not know
        assert not plan_for(GibbsConfig(5, 10), COLOURING, params=1.0, context=edges).valid


@pytest.mark.parametrize(
    ("name", "places", "names"),
    [
        ("places", np.arange(3.0), np.zeros((3, 3), int)),
        ("places", None, np.zeros((3, 3), int)),
        ("names", np.arange(3), np.zeros((2, 3), int)),
        ("names", np.arange(3), np.zeros((3, 3))),
    ],
)
def test_turned_contexts_of_other_shapes_or_types_raise_an_error(name, places, names):
    energy = symmetric(mislead(), lambda key, context: Turned(context, places, names))
    with pytest.raises(UserError, match=f"{name} of a Turned must be integers of shape"):
        energy.turn((), jax.random.key(0), energy.encode((), jnp.arange(3)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GibbsConfig(5, 5, fill="uncertain"), "unknown fill 'uncertain'"),
        (lambda: GibbsConfig(5, 5, certainty=0.9), "fill 'together' fills all"),
        (lambda: GibbsConfig(5, 5, fill="margin", certainty=1.5), "certainty"),
        (lambda: GibbsConfig(5, 5, fill="margin", entropy_bound=-1.0), "entropy_bound"),
        (lambda: GibbsConfig(5, 5, keep="first"), "unknown keep 'first'"),
        (lambda: GibbsConfig(5, 5, cool_to=-1.0), "temperature"),
        (lambda: GibbsConfig(5, 5, judge="sum"), "unknown judge 'sum'"),
        (lambda: GibbsConfig(5, 5, enough=0.1), "set restarts"),
        (lambda: GibbsConfig(5, 5, restarts=2, enough=np.nan), "enough"),
        (lambda: BeamConfig(5, fill="together"), "unknown fill 'together'"),
        (lambda: BeamConfig(5, judge="length"), "unknown judge 'length'"),
        (lambda: BeamConfig(5, temperature=1.0, entropy_bound=0.1), "use one of the two"),
        (lambda: from_factors(None, None, 3, degree=0), "degree"),
        (
            lambda: gibbs(ENUMERABLE, None, None, None, BeamConfig()),
            "expected GibbsConfig, got Beam",
        ),
        (lambda: beam_search(ENUMERABLE, None, None, None, GibbsConfig()), "expected BeamConfig"),
        (lambda: random_shooting(ENUMERABLE, None, None, None, None), "expected ShootingConfig"),
        (lambda: cross_entropy_method(ENUMERABLE, None, None, None, None), "expected CrossEntropy"),
        (
            lambda: plan_for(
                GibbsConfig(3, 3, fill=lambda energies, key: energies[:2, 0]),
                params=random_table(0, HORIZON, ACTIONS),
            ),
            r"fill must return a rank for each position, \[3\], got \[2\]",
        ),
    ],
)
def test_invalid_settings_raise_an_error(make, message):
    with pytest.raises(ValueError, match=message):
        make()
