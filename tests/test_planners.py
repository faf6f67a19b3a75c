import functools
import pickle
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.batching import NotANumber, check_fit, compile_planner, plan_keys, split_batch
from leapjax.energy import autoregressive, compose, constrain, from_total, view
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
    plan_counts,
    random_table,
)
from tests.programs import only_long
from tests.quick import many_plans, quick_jit

HORIZON, ACTIONS = 3, 3
PLANS = all_plans(HORIZON, ACTIONS)
NO_TILT = np.zeros((HORIZON, ACTIONS), np.float32)
ENUMERABLE = enumerable_energy(HORIZON, ACTIONS)
FROM_TOTAL = from_total(ENUMERABLE.encode, ENUMERABLE.total, ACTIONS)
TABLE = random_table(0, HORIZON, ACTIONS)
JOINT = joint_probabilities(TABLE)
CHAINS = 5000
assert_equal = np.testing.assert_array_equal
assert_close = functools.partial(np.testing.assert_allclose, rtol=1e-4)
REJECTED, ACCEPTED = 1e-9, 1e-3  # p-values: maximum of a wrong sampler, minimum of a right sampler


def plan_all(energy, config, params=TABLE, context=NO_TILT, chains=CHAINS, seed=0):
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
FORBIDDEN, ONLY = NO_TILT.copy(), NO_TILT.copy()  # first action: not 2 (as the end action); only 0
FORBIDDEN[0, 2] = ONLY[0, 1:] = -np.inf
POSSIBLE = (PLANS[:, 0] != 2) / 18
OTHER_TABLE = random_table(1, HORIZON, ACTIONS)
STEEP = 6 * TABLE  # the likeliest plan has probability 0.6, so replacement matters


def _guarded_total(params, memory, actions):
    return jnp.where(actions[0] == 2, jnp.inf, ENUMERABLE.total(params, memory, actions))


def _least_certain(energies, key):
    return jnp.nanmin(jnp.where(jnp.isinf(energies), jnp.nan, energies), axis=-1)


def likelier_of_pair(pairs, joint=JOINT):
    """The distribution of the likelier plan of a pair, for a distribution of pairs `[A^T, A^T]`."""
    p, rows = joint.reshape(-1), np.arange(len(PLANS))
    found = np.where(p[:, None] >= p, rows[:, None], rows)
    return np.bincount(found.reshape(-1), pairs.reshape(-1), len(rows))


def best_of(probabilities, count):
    """The distribution of the plan of least energy among independent draws."""
    if count == 1:
        return np.ravel(probabilities)
    return likelier_of_pair(np.outer(best_of(probabilities, count - 1), probabilities))


def best_child(parents, beginnings):
    """The distribution of the better of a plan and its child, with a random action changed.

    Args:
        parents: `[A^T]` probabilities.
        beginnings: number of possible first actions; a single one never changes.
    """
    differ, pairs = PLANS[:, None] != PLANS, 0
    for t in range(HORIZON):
        others = differ[..., t] & (differ.sum(-1) == 1) & (PLANS[:, 0] < beginnings)
        others |= ~others.any(1, keepdims=True) & np.eye(len(PLANS), dtype=bool)
        pairs += parents[:, None] * others / others.sum(1, keepdims=True) / HORIZON
    return likelier_of_pair(pairs)


def greedy_once(joint):
    """The distribution of plans of a joint after a random position took its likeliest action."""
    exact = np.zeros(len(PLANS))
    for plan in PLANS:
        for t in range(HORIZON):
            changed = plan.copy()
            changed[t] = conditional_by_counting(joint, plan, t).argmax()
            exact[(changed == PLANS).all(1)] += joint[tuple(plan)] / HORIZON
    return exact


def left_to_right(temperature):
    """The distribution of plans whose actions are drawn from left to right."""
    exact = np.ones(len(PLANS))
    for row, plan in enumerate(PLANS):
        for t, action in enumerate(plan):
            tokens = np.array([*plan[:t], *[ACTIONS] * (HORIZON - t)])
            p = conditional_by_counting(JOINT, tokens, t) ** (1 / temperature)
            exact[row] *= p[action] / p.sum()
    return exact


def two_beams(joint, replacement):
    """The distribution of the better of two plans, drawn with or without replacement."""
    p = joint.reshape(-1)
    pairs = np.outer(p, p) if replacement else np.outer(p / (1 - p), p) * (1 - np.eye(len(p)))
    return likelier_of_pair(pairs, joint)


class Sampler(NamedTuple):
    """A planner, the exact distribution of its plans, and a wrong distribution."""

    config: PlannerConfig
    exact: np.ndarray
    wrong: np.ndarray
    energy: Energy = ENUMERABLE
    params: object = TABLE
    context: np.ndarray = NO_TILT


def _gibbs(iterations=50, temperature=1.0, **options):
    return GibbsConfig(HORIZON, iterations, temperature=temperature, **options)


GUARDED = from_total(ENUMERABLE.encode, _guarded_total, ACTIONS)
COLD_JOINT = joint_probabilities(2 * TABLE.astype(np.float64))
STEEP_BEAMS = [two_beams(joint_probabilities(STEEP), replacement) for replacement in (False, True)]
BRED = CrossEntropyConfig(HORIZON, 2, candidates=2, elites=1)
BEGIN_ALIKE = best_of((PLANS[:, 0] == 0) / 9, 2)
SAMPLERS = {
    "gibbs": Sampler(_gibbs(), JOINT, INDEPENDENT),
    "sequential gibbs": Sampler(_gibbs(order="sequential"), JOINT, INDEPENDENT),
    "gibbs on totals": Sampler(_gibbs(), JOINT, INDEPENDENT, FROM_TOTAL),
    "cold gibbs": Sampler(_gibbs(temperature=0.5), COLD_JOINT, JOINT),
    "first pass": Sampler(_gibbs(1), INDEPENDENT, JOINT),
    "all positions in each pass": Sampler(_gibbs(3, resampled=HORIZON), INDEPENDENT, JOINT),
    # After a forbidden first action, all later actions would have infinite energy.
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
    "bred": Sampler(BRED, best_child(best_of(UNIFORM, 2), 3), best_of(UNIFORM, 2)),
    "bred possible": Sampler(
        BRED, best_child(best_of(POSSIBLE, 2), 2), best_of(POSSIBLE, 2), context=FORBIDDEN
    ),
    "bred with one beginning": Sampler(BRED, best_child(BEGIN_ALIKE, 1), BEGIN_ALIKE, context=ONLY),
    "beam": Sampler(BeamConfig(HORIZON, 1, 1.0), JOINT, INDEPENDENT),
    "warm beam": Sampler(BeamConfig(HORIZON, 1, 2.0), left_to_right(2.0), JOINT),
    "two beams": Sampler(BeamConfig(HORIZON, 2, 1.0), *STEEP_BEAMS, params=STEEP),
    "beam by certainty": Sampler(BeamConfig(HORIZON, 1, 1.0, fill="confident"), JOINT, INDEPENDENT),
    "two beams by certainty": Sampler(
        BeamConfig(HORIZON, 2, 1.0, fill="confident"), *STEEP_BEAMS, params=STEEP
    ),
    "a fill of one's own": Sampler(_gibbs(HORIZON, fill=_least_certain), JOINT, INDEPENDENT),
    "cooled to 0": Sampler(
        _gibbs(HORIZON + 1, fill="random", cool_to=0.0), greedy_once(JOINT), JOINT
    ),
}


# The other samplers imply these.
LIKE_OTHERS = ("sequential gibbs", "margin fill", "best restart", "two beams by certainty")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[only_long] * (name in LIKE_OTHERS)) for name in SAMPLERS],
)
def test_plans_are_drawn_from_the_exact_distribution(name):
    config, exact, wrong, energy, params, context = SAMPLERS[name]
    counts = plan_counts(plan_all(energy, config, params, context).actions, ACTIONS)
    assert fit_p_value(counts, exact) > ACCEPTED
    assert fit_p_value(counts, wrong) < REJECTED


@pytest.mark.parametrize(
    "config",
    [_gibbs(temperature=1.25), _gibbs(2, fill="random", resampled=2)],
    ids=["warm", "two at once"],
)
def test_broken_samplers_do_not_fit_the_joint(config):
    counts = plan_counts(plan_all(ENUMERABLE, config).actions, ACTIONS)
    assert fit_p_value(counts, JOINT) < REJECTED


def greedy_traces(config):
    """Returns traces `[100, N, T]` at temperature 0 on 100 joints, and the joints."""
    tables = np.stack([random_table(seed, HORIZON, ACTIONS) for seed in range(100)])
    plan = quick_jit(jax.vmap(bind(ENUMERABLE, config), (0, None, None)))
    trace = plan(tables, jax.random.key(1), NO_TILT).trace
    return np.asarray(trace), [joint_probabilities(table) for table in tables]


@pytest.mark.parametrize(
    ("order", "fill"), [("random", "together"), ("sequential", "together"), ("uncertain", "random")]
)
def test_greedy_gibbs_never_raises_the_joint_energy(order, fill):
    traces, joints = greedy_traces(GibbsConfig(HORIZON, 16, order=order, fill=fill))
    if fill != "together":
        traces = traces[:, HORIZON - 1 :]
    changes = np.array([np.diff(joint_energies(t, j)) for t, j in zip(traces, joints, strict=True)])
    assert (changes <= 1e-5).all() and (changes < -0.1).any()
    for trace, joint in zip(traces, joints, strict=True):  # no single change lowers the energy
        for t in range(HORIZON):
            conditional = conditional_by_counting(joint, trace[-1], t)
            assert conditional[trace[-1, t]] == pytest.approx(conditional.max(), rel=1e-5)


# Filling a plan position by position.


@pytest.mark.parametrize("fill", [fill for fill in FILLS if fill != "together"])
def test_each_pass_fills_p_positions_and_keeps_earlier_ones(fill):
    trace = plan_all(ENUMERABLE, _gibbs(2, fill=fill, resampled=2), chains=200).trace
    known = trace < ACTIONS  # [chains, N, T]
    assert (known.sum(-1) == [2, 3]).all()
    assert ((trace[:, 0] == trace[:, 1]) | ~known[:, 0]).all()
    if fill == "sequential":
        assert known[:, 0, :2].all()


@pytest.mark.parametrize("fill", ["confident", "margin"])
def test_the_most_certain_position_is_filled_first(fill):
    firsts = set()
    for trace, joint in zip(*greedy_traces(GibbsConfig(HORIZON, HORIZON, fill=fill)), strict=True):
        tokens = BLANK
        for after in trace:
            certainty = np.full(HORIZON, -np.inf)
            for t in np.flatnonzero(tokens == ACTIONS):
                second, likeliest = np.sort(conditional_by_counting(joint, tokens, t))[-2:]
                certainty[t] = likeliest if fill == "confident" else likeliest - second
            (chosen,) = np.flatnonzero(after != tokens)
            assert certainty[chosen] == pytest.approx(certainty.max(), rel=1e-4)
            conditional = conditional_by_counting(joint, tokens, chosen)
            assert conditional[after[chosen]] == pytest.approx(conditional.max(), rel=1e-4)
            tokens = after
        firsts.add(np.flatnonzero(trace[0] < ACTIONS)[0])
    assert len(firsts) == HORIZON


# Which positions are resampled.

CERTAINTY = np.array([2.0, 0.5, 3.0, 1.0], np.float32)  # of the four positions


def _next_action(params, memory, actions, positions):
    successors = (actions[positions] + 1) % 5
    energies = jnp.where(jnp.arange(5) == successors[:, None], 0.0, 1.0)
    return energies * jnp.array(CERTAINTY)[positions][:, None]


# Resampling increments an action, so the trace shows which positions were resampled.
COUNTER = Energy(lambda params, context: None, _next_action, lambda *_: jnp.zeros(()), 5)


def resampled_positions(config, chains):
    """Whether each iteration after the first resampled each position: `[chains, N - 1, T]`."""
    steps = np.diff(plan_all(COUNTER, config, None, None, chains).trace, axis=1) % 5
    assert np.isin(steps, (0, 1)).all()
    return steps.astype(bool)


@pytest.mark.parametrize("resampled", [1, 2])
def test_random_order_is_uniform_over_sets_of_distinct_positions(resampled):
    changed = resampled_positions(GibbsConfig(4, iterations=4, resampled=resampled), 1500)
    possible = np.array([bin(i).count("1") == resampled for i in range(16)])
    counts = np.bincount((changed @ (2 ** np.arange(4))).reshape(-1), minlength=16)
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
def test_all_positions_are_resampled_before_any_repeats(order, resampled, expected):
    """Sequential order is cyclic; "uncertain" takes the least certain positions first."""
    config = GibbsConfig(4, 1 + len(expected), resampled, order=order)
    (row,) = resampled_positions(config, chains=1)
    assert [set(np.flatnonzero(step)) for step in row] == expected


# The fields of a plan.

CONFIGS = {
    "gibbs": GibbsConfig(HORIZON, iterations=5, temperature=0.7, score=True),
    "shooting": ShootingConfig(HORIZON, candidates=6, score=True),
    "cross entropy": CrossEntropyConfig(HORIZON, iterations=5, candidates=6, elites=2, score=True),
    "beam": BeamConfig(HORIZON, 2, temperature=0.7, score=True),
}
EACH_PLANNER = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
SCORED = _gibbs(HORIZON, fill="confident", score=True, score_trace=True)


@pytest.mark.parametrize("config", [*CONFIGS.values(), SCORED], ids=[*CONFIGS, "scored trace"])
def test_plan_fields_agree_and_depend_only_on_the_key(config):
    plan = plan_all(ENUMERABLE, config, chains=50)
    assert plan.trace.shape == (50, getattr(config, "iterations", 1), HORIZON)
    assert plan.actions.dtype == plan.trace.dtype == np.int32
    assert_equal(plan.trace[:, -1], plan.actions)
    assert_close(plan.energy, joint_energies(plan.actions))
    assert plan.satisfied.all() and plan.valid.all()
    assert (plan.trace_energies is None) == (config is not SCORED)
    if config is SCORED:
        assert_equal(plan.trace_energies[:, -1], plan.energy)
        assert np.isposinf(plan.trace_energies[:, :-1]).all()  # incomplete plans
    jax.tree.map(assert_equal, plan, plan_all(ENUMERABLE, config, chains=50))
    other = plan_all(ENUMERABLE, config, chains=50, seed=1)
    assert (plan.actions != other.actions).any(-1).mean() > 0.2
    unscored = jax.eval_shape(
        bind(ENUMERABLE, type(config)(HORIZON)), TABLE, jax.random.key(0), NO_TILT
    )
    assert unscored.energy is None and unscored.trace_energies is None


# The cross-entropy method.


def test_cross_entropy_keeps_elites_and_mutates_each():
    scored = []

    def total(params, memory, actions):  # plans are far apart, so a child shows its parent
        jax.debug.callback(lambda a: scored.append(a.copy()), actions)
        return jnp.sum(actions * 2.5 ** jnp.arange(12))

    planner = bind(
        from_total(lambda params, context: None, total, ACTIONS),
        CrossEntropyConfig(12, 2, candidates=12, elites=3),
    )
    plan = jax.block_until_ready(quick_jit(planner)(None, jax.random.key(0), None))
    jax.effects_barrier()
    energies = np.array(scored) @ 2.5 ** np.arange(12)
    first, second = np.array(scored[:12]), np.array(scored[12:])
    elites = first[np.argsort(energies[:12])[:3]]
    distances = (second[:, None] != elites[None]).sum(-1)  # [candidates, elites]
    assert sorted(distances.min(1)) == [0] * 3 + [1] * 9
    assert_equal((distances == 0).sum(0), [1, 1, 1])
    assert_equal((distances == 1).sum(0), [3, 3, 3])
    assert_equal(plan.trace[0], elites[0])
    assert_equal(plan.actions, scored[energies.argmin()])


# Beam search.


def slow_beam_search(joint, width):
    """Returns the best beam after every position; counts plans to find conditionals."""
    beams, trace = [(0.0, ())], []
    for t in range(HORIZON):
        extended = []
        for energy, plan in beams:
            tokens = np.array([*plan, *[ACTIONS] * (HORIZON - t)])
            for action, p in enumerate(conditional_by_counting(joint, tokens, t)):
                extended.append((energy - np.log(p), (*plan, action)))
        beams = sorted(extended)[:width]
        trace.append([*beams[0][1], *[ACTIONS] * (HORIZON - 1 - t)])
    return np.array(trace)


@pytest.mark.parametrize(("width", "temperature"), [(1, 0), (1, 1e-30), (2, 0), (40, 0)])
def test_beam_search_equals_a_slow_implementation(width, temperature):
    """From 2 beams on it finds the likeliest plan of all six joints; with 1 it does not."""
    found = []
    for seed in range(6):
        table = random_table(seed, HORIZON, ACTIONS)
        joint = joint_probabilities(table)
        config = BeamConfig(HORIZON, width, temperature)
        [trace] = plan_all(ENUMERABLE, config, table, chains=1).trace
        assert_equal(trace, slow_beam_search(joint, width))
        found.append((trace[-1] == PLANS[joint.argmax()]).all())
    assert all(found) == (width > 1)


@pytest.mark.parametrize(("partial", "temperature"), [(False, 0.0), (True, 1.0)])
def test_beam_search_returns_an_allowed_plan_if_one_exists(partial, temperature):
    """A beam in a dead end pays no energy there, so its sum is the least."""

    def forbids_first(context, actions):  # applies once a second action is chosen
        return jnp.where((actions[0] != 2) & (actions[1] < ACTIONS), jnp.inf, 0.0)

    tilt = NO_TILT.copy()
    tilt[0, 2] = -5.0  # the only allowed first action is the least likely
    safe = constrain(ENUMERABLE, forbids_first, partial=partial)
    config = BeamConfig(HORIZON, 40, temperature, score=True)
    plan = plan_all(safe, config, np.zeros_like(TABLE), tilt, chains=100)
    assert (plan.actions[:, 0] == 2).all() and plan.satisfied.all() and plan.valid.all()
    assert_equal(plan.actions, plan.trace[:, -1])
    assert np.isfinite(plan.energy).all()


# Planning under constraints. Context: a tilt and a price for each action at each position.


def compute_price(context, actions):
    return context["price"][jnp.arange(HORIZON), actions].sum()


CONSTRAINED = constrain(view(ENUMERABLE, lambda context: context["tilt"]), compute_price)


def prices(*forbidden, price=np.inf):
    result = np.zeros((HORIZON, ACTIONS), np.float32)
    result[tuple(np.transpose(forbidden))] = price
    return result


def price_plans(plans, price):
    return price[np.arange(HORIZON), plans].sum(-1)


@pytest.mark.parametrize(
    "config",
    [
        GibbsConfig(HORIZON, iterations=3, temperature=1.0, score=True, score_trace=True),
        GibbsConfig(HORIZON, iterations=3, restarts=2, temperature=0.3, score=True),
        ShootingConfig(HORIZON, candidates=2, score=True),
        CrossEntropyConfig(HORIZON, 2, candidates=3, elites=1, score=True),
    ],
)
def test_satisfied_marks_exactly_the_plans_without_penalty(config):
    cells = [(0, 0), (0, 1), (1, 1), (1, 2), (2, 0), (2, 2)]
    for price in (prices(*cells, price=0.5), prices(*cells), np.full_like(NO_TILT, np.inf)):
        plan = plan_all(CONSTRAINED, config, context={"tilt": NO_TILT, "price": price}, chains=300)
        penalties = price_plans(plan.actions, price)
        assert_equal(plan.satisfied, penalties == 0)
        assert penalties.any() and (penalties > 0).all() == (price > 0).all()
        # Energies are never NaN, and an infinite price makes them infinite.
        assert_close(plan.energy, joint_energies(plan.actions) + penalties)
        if plan.trace_energies is not None:
            expected = joint_energies(plan.trace) + price_plans(plan.trace, price)
            assert_close(plan.trace_energies, expected)


def test_constrained_gibbs_samples_the_joint_given_the_constraint():
    price = prices((0, 0), (2, 1))
    plan = plan_all(CONSTRAINED, _gibbs(), context={"tilt": NO_TILT, "price": price})
    # Single steps cannot remove two violations at once: chains stay in such plans.
    found = plan.actions[plan.satisfied]
    assert len(found) > CHAINS / 2
    allowed = JOINT.copy()
    allowed[0] = allowed[:, :, 1] = 0
    assert fit_p_value(plan_counts(found, ACTIONS), allowed / allowed.sum()) > ACCEPTED


def test_gibbs_keeps_actions_while_all_totals_are_infinite():
    """If only position 1 must change, resampling position 0 first keeps its action."""

    def total(params, memory, actions):
        return jnp.where(jnp.any(actions == 0), jnp.inf, 0.0)

    energy = from_total(lambda params, context: None, total, ACTIONS)
    config = GibbsConfig(2, iterations=9, order="sequential")
    plan = plan_all(energy, config, None, None, chains=100)
    reachable = (plan.trace[:, 0] == 0).sum(-1) <= 1
    assert reachable.any() and not (plan.actions[reachable] == 0).any()


# Batches.


def make_batch(batch, seed=0):
    """Makes distinct keys and contexts, as NumPy arrays."""
    tilts = np.random.default_rng(seed).normal(size=(batch, HORIZON, ACTIONS)).astype(np.float32)
    return plan_keys(seed, np.arange(batch), np.zeros(batch, int)), {"tilt": tilts}


TILTED = view(ENUMERABLE, lambda context: context["tilt"])
GIBBS = CONFIGS["gibbs"]


@functools.cache
def compile_batched(config, devices=None):
    sizes = (8, 2) if isinstance(config, GibbsConfig) else (7,)
    return compile_planner(TILTED, config, sizes, jax.devices()[:devices])


@functools.cache
def plan_singly(config):
    """Plans for 20 contexts, each in its own unbatched call."""
    keys, contexts = make_batch(20)
    single = quick_jit(bind(TILTED, config))
    plans = [single(TABLE, keys[i], {"tilt": contexts["tilt"][i]}) for i in range(20)]
    return jax.tree.map(lambda *rows: np.stack(rows), *plans)


@EACH_PLANNER
def test_batched_plans_equal_single_plans_on_any_devices(config):
    keys, contexts = make_batch(20)
    for batch, devices in [(1, None), (2, None), (7, None), (9, None), (20, 2)]:
        planner = compile_batched(config, devices if config is GIBBS else None)
        plan = planner(TABLE, keys[:batch], {"tilt": contexts["tilt"][:batch]})
        expected = jax.tree.map(lambda x, n=batch: x[:n], plan_singly(config))
        for name in ("actions", "trace", "satisfied"):
            assert_equal(getattr(plan, name), getattr(expected, name))
        assert_close(plan.energy, expected.energy)


@pytest.mark.parametrize(
    ("batch", "sizes", "chunks"),
    [
        (40, [16, 128], [16, 16, 16]),
        (4, [1, 16], [1, 1, 1, 1]),
        (5, [1, 16], [16]),
        (300, [32, 128], [128, 128, 32, 32]),
        (110, [32, 128], [128]),
    ],
)
def test_chunks_have_little_padding(batch, sizes, chunks):
    found = split_batch(batch, sizes)
    assert [size for _, size, _ in found] == chunks
    rows = [row for start, _, used in found for row in range(start, start + used)]
    assert rows == list(range(batch))


@pytest.mark.parametrize(
    ("config", "sizes"),
    [
        (GibbsConfig(2, 4), (1, 16, 128)),
        (GibbsConfig(2, 4, fill="confident", certainty=0.9), (1, 4)),
        (GibbsConfig(2, 4, restarts=2, enough=0.1), (1, 4)),
        (BeamConfig(2, fill="confident", entropy_bound=0.1), (1, 4)),
        (ShootingConfig(2), (1, 16, 128)),
    ],
)
def test_default_chunks_are_small_if_passes_vary(config, sizes):
    assert compile_planner(TILTED, config).chunk_sizes == sizes


def test_compiling_ahead_prevents_later_tracing_and_compilation(caplog):
    traced = []

    def encode(params, context):
        traced.append(context)
        return ENUMERABLE.encode(params, context)

    def plan(planner, batch):
        contexts = np.broadcast_to(NO_TILT, (batch, *NO_TILT.shape))
        planner(TABLE, jax.random.split(jax.random.key(0), batch), contexts)

    energy = ENUMERABLE._replace(encode=encode)
    planner = compile_planner(energy, GIBBS, (1, 4, 16))
    planner.compile(TABLE, NO_TILT, 20)
    before = len(traced)
    assert before
    with jax.log_compiles():
        for batch in (1, 3, 4, 15, 20):
            plan(planner, batch)
        assert len(traced) == before and "program" not in caplog.text
        plan(compile_planner(energy, GIBBS, (1, 4, 16)), 1)
    assert len(traced) > before and "program" in caplog.text


def test_planning_with_a_cache_is_compiled_ahead(caplog):
    def encode_next(params, context, cache):
        seen = jnp.zeros((), int) if cache is None else cache
        return ENUMERABLE.encode(params, context), seen + 1

    planner = compile_planner(ENUMERABLE, GIBBS, (4,), encode_next=encode_next)
    planner.compile(TABLE, NO_TILT, 4)
    contexts, cache = np.broadcast_to(NO_TILT, (4, *NO_TILT.shape)), None
    keys = jax.random.split(jax.random.key(0), 4)
    with jax.log_compiles():
        for step in (1, 2, 3):
            _, cache = planner.plan_next(TABLE, keys, contexts, cache)
            assert_equal(cache, np.full(4, step))
    assert "program" not in caplog.text


def test_keys_depend_only_on_seed_episode_and_replan():
    episodes, replans = np.array([3, 0, 3, 1]), np.array([0, 2, 1, 2])
    data = np.asarray(jax.random.key_data(plan_keys(7, episodes, replans)))
    shuffled = jax.random.key_data(plan_keys(7, episodes[::-1], replans[::-1]))
    assert_equal(shuffled, data[::-1])
    assert_equal(plan_keys(7, episodes[1:2], replans[1:2]), data[1:2])
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2)
    keys = [jax.random.key_data(plan_keys(seed, grid[:, 0], grid[:, 1])) for seed in (0, 1)]
    assert len(np.unique(np.concatenate(keys), axis=0)) == 2 * len(grid)
    with jax.default_prng_impl("rbg"):
        assert_equal(plan_keys(7, episodes, replans), data)


def test_changed_parameters_or_trees_are_placed_again():
    keys, contexts = make_batch(8)
    first, second = jnp.asarray(TABLE), jnp.asarray(OTHER_TABLE)
    planner = compile_planner(
        TILTED._replace(encode=lambda p, c: TILTED.encode(p[0] if p[1] is None else -p[1], c)),
        GIBBS,
        (8,),
    )

    def check(params, table):
        expected = compile_batched(GIBBS)(table, keys, contexts)
        assert_equal(planner(params, keys, contexts).actions, expected.actions)

    for table in (first, first, second, first):
        check((table, None), table)
    check((None, first), -first)
    # A NumPy array is placed in every call, because its owner may write to it.
    written = np.array(first)
    check((written, None), first)
    written[...] = second
    check((written, None), second)


# Energies that take MASK at later positions only.


def _read_left(params, memory, tokens, positions):
    """Scores actions given earlier ones; NaN if an earlier one is MASK."""

    def score(position):
        earlier = jnp.arange(HORIZON) < position
        known = jnp.where(earlier, tokens, ACTIONS)
        scores = -ENUMERABLE.conditional(params, memory, known, position[None])[0]
        return jnp.where(jnp.any(earlier & (tokens == ACTIONS)), jnp.nan, scores)

    return jax.vmap(score)(positions)


LEFT_TO_RIGHT = autoregressive(ENUMERABLE.encode, _read_left, ACTIONS)


@pytest.mark.parametrize(
    "config",
    [
        BeamConfig(HORIZON, len(PLANS)),
        GibbsConfig(HORIZON, 5, restarts=2),
        ShootingConfig(HORIZON),
        pytest.param(BeamConfig(HORIZON, 2, temperature=1.0, score=True), marks=only_long),
        pytest.param(CrossEntropyConfig(HORIZON), marks=only_long),
    ],
)
def test_planners_mask_only_later_actions_of_a_left_to_right_energy(config):
    plans = plan_all(LEFT_TO_RIGHT, config, chains=20)
    assert plans.valid.all() and (plans.actions < ACTIONS).all()
    if config == BeamConfig(HORIZON, len(PLANS)):
        assert_equal(plans.actions[0], PLANS[joint_energies(PLANS).argmin()])
        both = compose([LEFT_TO_RIGHT, ENUMERABLE])
        assert plan_all(both, config, (TABLE, TABLE), chains=20).valid.all()
        assert not compose([both, FROM_TOTAL]).left_to_right


# Energies that are NaN or -inf. Parameters: a table, and the value of undefined energies.

UNDEFINED = ENUMERABLE._replace(
    encode=lambda params, context: (ENUMERABLE.encode(params[0], context), params[1]),
    conditional=lambda params, memory, *plan: ENUMERABLE.conditional(params, memory[0], *plan),
    total=lambda params, memory, actions: memory[1],
)


def _undefined_at_first(params, memory, actions, positions):
    energies = UNDEFINED.conditional(params, memory, actions, positions)
    return jnp.where(jnp.all(actions == ACTIONS), energies.at[0, 1].set(memory[1]), energies)


UNDEFINED_AT_FIRST = UNDEFINED._replace(
    conditional=_undefined_at_first,
    total=lambda params, memory, actions: ENUMERABLE.total(params, memory[0], actions),
)


@pytest.mark.parametrize(
    ("energy", "config"),
    [
        (UNDEFINED, GibbsConfig(HORIZON, 3, score=True)),
        (UNDEFINED, GibbsConfig(HORIZON, 3, score_trace=True)),
        (UNDEFINED, GibbsConfig(HORIZON, 3, restarts=2)),
        (UNDEFINED, ShootingConfig(HORIZON)),
        (UNDEFINED, CrossEntropyConfig(HORIZON)),
        (UNDEFINED, BeamConfig(HORIZON, score=True)),
        (UNDEFINED_AT_FIRST, GibbsConfig(HORIZON, 3)),
        (UNDEFINED_AT_FIRST, ShootingConfig(HORIZON)),
        (UNDEFINED_AT_FIRST, CrossEntropyConfig(HORIZON)),
        (UNDEFINED_AT_FIRST, BeamConfig(HORIZON)),
    ],
)
def test_plans_with_undefined_energies_are_invalid(energy, config):
    for value, valid in ((np.nan, False), (-np.inf, False), (1.0, True)):
        plan = plan_all(energy, config, (TABLE, np.float32(value)), chains=2)
        assert (plan.valid == valid).all()


def test_nan_energies_raise_an_error_that_holds_the_plans():
    keys, contexts = make_batch(20)
    contexts["tilt"][3, 1] = np.nan
    with pytest.raises(NotANumber, match=r"1 of 20 contexts \(the first is context 3\)") as error:
        compile_batched(GIBBS)(TABLE, keys, contexts)
    assert str(pickle.loads(pickle.dumps(error.value))) == str(error.value)
    plan = error.value.plan
    assert plan.valid.sum() == 19
    assert_equal(plan.actions[4:], plan_singly(GIBBS).actions[4:])


# Valid and invalid arguments.

KEYS, CONTEXTS = make_batch(2)


def test_keys_and_contexts_of_many_types_are_accepted():
    expected = compile_batched(GIBBS)(TABLE, KEYS, CONTEXTS)
    types = {str(kind): np.zeros(2, kind) for kind in (jnp.bfloat16, np.uint64, bool)}
    for keys in (jax.random.wrap_key_data(KEYS), [*KEYS], KEYS):
        plan = compile_batched(GIBBS)(TABLE, keys, CONTEXTS | (types if keys is KEYS else {}))
        jax.tree.map(assert_equal, plan, expected)
    for fits in ([2**31 - 1, -(2**31)], [np.nan, -np.inf, 3e38, 1 / 3], []):
        check_fit("context", {"x": np.array(fits)})
    check_fit("context", {"x": np.array([2**32 - 1], np.uint64)})


def _plan(keys=KEYS, params=TABLE, **context):
    return compile_batched(GIBBS)(params, keys, CONTEXTS | context)


def _plan_in_wrong_shape(name, config):
    wrong = ENUMERABLE._replace(**{name: lambda *arguments: jnp.zeros((2, 7))})
    jax.eval_shape(bind(wrong, config), TABLE, jax.random.key(0), NO_TILT)


WIDE = (np.array([0, 2**31]), np.array([0, 2**32], np.uint64), np.array([np.inf, -1e39]))
WRONG = [
    (lambda: _plan(KEYS[0]), "expected one for each context"),
    (lambda: _plan(KEYS.astype(np.int64)), r"raw keys must be \[B, 2\] uint32"),
    (lambda: _plan("keys"), "keys must be an array"),
    (lambda: _plan(KEYS[:0], tilt=np.zeros((0, HORIZON, ACTIONS))), "no contexts"),
    (lambda: _plan(tilt=np.zeros((3, HORIZON, ACTIONS))), r"'tilt'\] has .* number of keys, 2"),
    (lambda: _plan(mission=np.array(["go", "stay"])), r"'mission'\] holds <U\d+, not numbers"),
    *(
        (lambda w=wide: _plan(more=[w]), r"context\['more'\]\[0\] holds .*does not fit")
        for wide in WIDE
    ),
    (lambda: _plan(params="words"), "params holds <U5, not numbers"),
    (lambda: _plan(more=jax.random.split(jax.random.key(0))), r"\['more'\] holds random keys"),
    (lambda: _plan(params={"more": WIDE[0]}), r"params\['more'\] holds .*does not fit"),
    (lambda: jax.jit(_plan)(KEYS), r"inside of jit, vmap or grad.* use leap.gibbs"),
    *(
        (lambda n=name, c=config: _plan_in_wrong_shape(n, c), rf"^{name} of .*, got shape \(2, 7\)")
        for config in CONFIGS.values()
        for name in ("conditional", "total", "violation")
    ),
    (lambda: plan_keys(-1, np.array([0]), np.array([0])), "seed must be"),
    (lambda: plan_keys(0, np.array([5.9]), np.array([0])), "episode must be"),
    (lambda: plan_keys(0, np.array([0]), np.array([2**32])), "replan must be"),
    (lambda: plan_keys(0, np.arange(2), np.arange(1)), "2 episodes, but 1 replans"),
    (lambda: compile_planner(TILTED, GIBBS, (8, -1)), "chunk sizes"),
    (lambda: compile_planner(TILTED, GIBBS, (1,), ["cpu"]), "devices must be a sequence"),
    (lambda: compile_batched(GIBBS).compile(TABLE, CONTEXTS, 0), "batch must be at least 1"),
    (lambda: plan_all(FROM_TOTAL, _gibbs(fill="margin")), "fill 'margin' .* use fill 'together'"),
    (lambda: plan_all(FROM_TOTAL, BeamConfig(HORIZON)), "accepts_mask is False"),
    *(
        (lambda c=config: plan_all(LEFT_TO_RIGHT, c), "from left to right|accepts_mask is False")
        for config in (
            _gibbs(fill="sequential"),
            _gibbs(restarts=2, judge="halves"),
            BeamConfig(HORIZON, fill="confident"),
            BeamConfig(HORIZON, certainty=0.9),
            BeamConfig(HORIZON, judge="halves"),
        )
    ),
    (lambda: bind(ENUMERABLE, {"horizon": 3}), "no planner takes a dict"),
    (lambda: GibbsConfig(0), "horizon must be at least 1, got 0"),
    (lambda: GibbsConfig(3, resampled=4), "resampled is 4, .* the horizon 3"),
    (lambda: GibbsConfig(3, order="backwards"), "unknown order 'backwards': .*sequential"),
    (lambda: GibbsConfig(5, 2, 2, fill="margin"), "needs 3"),
    (lambda: CrossEntropyConfig(candidates=2, elites=3), "3 elites out of 2 candidates"),
    (lambda: BeamConfig(temperature=-1.0), "a temperature must be in"),
    (lambda: GibbsConfig(temperature=1e31), "a temperature must be in"),
]


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_invalid_arguments_raise_an_error(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()
