"""Methods that learn from rewards find what is best in data of which most is not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.agents import bc, bcq, cql, dt, iql, leap, mopo, qr_dqn, rem, returns
from leapjax.agents.learning import Setup, TrainingConfig
from leapjax.errors import UserError
from leapjax.models.trajectory import ModelConfig
from tests import mixed, toy
from tests.programs import only_long
from tests.quick import quick_jit
from tests.toy import LEFT, RIGHT, WAIT

MODULES = {
    "bc": bc, "dt": dt, "bcq": bcq, "iql": iql, "mopo": mopo, "cql": cql, "qr_dqn": qr_dqn,
    "rem": rem,
}  # fmt: skip
QUICKLY = {"discount": 0.9, "target_rate": 0.1}
SETTINGS = {
    "bc": bc.Settings(),
    "bcq": bcq.Settings(**QUICKLY),
    # Advantages are small here: far from the middle a wrong step costs a tenth.
    "iql": iql.Settings(**QUICKLY, inverse_temperature=20.0),
    # What is imagined is wrong at first: with more of it, some runs end up going one way.
    "mopo": mopo.Settings(**QUICKLY, inverse_temperature=10.0, real_share=0.8),
    # The conservative term must not cost more than a wrong step.
    "cql": cql.Settings(**QUICKLY, alpha=0.1),
    "cql without": cql.Settings(**QUICKLY, alpha=0.0),
    "qr_dqn": qr_dqn.Settings(**QUICKLY, quantiles=8),
    "rem": rem.Settings(**QUICKLY, q_heads=8),
}
# Without waiting, which nobody does in the data: what is not there has any value at all, and
# these two do nothing about that.
COVERED = dict.fromkeys(("qr_dqn", "rem"), mixed.DOMAIN._replace(actions=("left", "right", "end")))
# What MOPO imagines is less sure to settle: at the others' rate one run in eight does not.
RATES = {"cql": 5e-3, "cql without": 5e-3, "qr_dqn": 5e-3, "rem": 5e-3, "mopo": 2e-3}


@functools.cache
def trained(name, architecture="leapjax", past=0):
    """An agent after a moment of training on walks that go wrong more often than right."""
    model = ModelConfig(architecture, layers=1, heads=1, width=32, dropout=0.0)
    rate = RATES.get(name, 3e-3)
    learn = TrainingConfig(
        300 if rate == 5e-3 else 600, batch=64 if rate == 5e-3 else 128, warmup=10,
        learning_rate=rate, final_fraction=0.0, weight_decay=0.0, windows="step",
    )  # fmt: skip
    setup = Setup(COVERED.get(name, mixed.DOMAIN), past, 1, model, learn, SETTINGS[name])
    agent = MODULES[name.split()[0]].make_agent(setup)
    return agent, *toy.learn(agent, mixed.steps(), learn.steps)


def energies(agent, params, past=0):
    """Of each action and the end, at each place."""

    @jax.jit
    @jax.vmap
    def of_place(context):
        nothing = jnp.zeros(1, jnp.int32)
        memory = agent.energy.encode(params, context)
        return agent.energy.conditional(params, memory, nothing, nothing)[0]

    return np.asarray(of_place(mixed.contexts(past)))


def acts(agent, params, past=0):
    """What it does first, from each place."""
    return energies(agent, params, past).argmin(axis=1)


@only_long
def test_cloning_does_what_was_done_most_often():
    agent, state, _ = trained("bc")
    inner = np.abs(mixed.PLACES) < toy.FARTHEST
    assert (acts(agent, state.params) != mixed.best_actions())[inner].all()


@pytest.mark.parametrize(  # what the others minimise is checked by hand
    ("name", "architecture", "past"),
    [
        ("cql", "leapjax", 0),
        *(pytest.param(name, "leapjax", 0, marks=only_long)
          for name in ("bcq", "iql", "mopo", "qr_dqn", "rem")),
        pytest.param("bcq", "paper", 2, marks=only_long),
    ],
)  # fmt: skip
def test_the_best_policy_is_found(name, architecture, past):
    agent, state, metrics = trained(name, architecture, past)
    found = energies(agent, state.params, past)
    np.testing.assert_array_equal(found.argmin(axis=1), mixed.best_actions())
    assert np.isposinf(found[:, -1]).all()  # the end is never chosen
    assert all(np.isfinite(list(entry.values())).all() for entry in metrics)


@only_long
@pytest.mark.parametrize("name", ["bcq", "cql without", "qr_dqn", "rem"])
def test_values_are_those_of_value_iteration(name):
    agent, state, _ = trained(name)
    best, rows = mixed.best_actions(), np.arange(len(mixed.PLACES))
    q = -energies(agent, state.params)
    found = np.stack([q[rows, best], q[rows, np.where(best == LEFT, RIGHT, LEFT)]], axis=1)
    np.testing.assert_allclose(found, mixed.best_values(0.9), atol=0.1)


@only_long
def test_cql_keeps_low_what_the_data_do_not_hold():
    agent, state, _ = trained("cql")
    other, without, _ = trained("cql without")
    conservative, plain = -energies(agent, state.params), -energies(other, without.params)
    assert (conservative[:, WAIT] < plain[:, WAIT] - 1).all()
    assert (conservative[:, WAIT] < conservative[:, [LEFT, RIGHT]].min(axis=1) - 1).all()
    best = mixed.best_values(0.9)[:, 0]
    assert (conservative[:, :WAIT].max(axis=1) < best).all()  # lower bounds


def test_mixtures_are_random_and_convex():
    weights = jax.vmap(rem.mixture, (0, None))(jax.random.split(jax.random.key(0), 500), 8)
    assert (weights >= 0).all() and weights.shape == (500, 8)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 8, atol=0.01)
    assert (weights.std(axis=0) > 0.04).all()
    np.testing.assert_array_equal(rem.mixture(jax.random.key(1), 1), [1])


def test_bcq_never_does_what_the_data_do_not_hold():
    """However good its value may look."""
    said = {
        "behaviour": jnp.log(jnp.array([[0.6, 0.3, 0.1], [0.5, 0.5, 0.0]])),
        "q": jnp.array([[1.0, 2.0, 9.0], [3.0, 4.0, 9.0]]),
    }
    np.testing.assert_array_equal(bcq.likely_values(said, 0.3), [[1, 2, -np.inf], [3, 4, -np.inf]])
    np.testing.assert_array_equal(bcq.likely_values(said, 0.0), said["q"])
    np.testing.assert_array_equal(
        bcq.likely_values(said, 1.0), [[1, -np.inf, -np.inf], [3, 4, -np.inf]]
    )


@pytest.mark.parametrize(
    ("name", "critic"),
    [
        ("cql", lambda params: params),
        pytest.param("iql", lambda params: {"params": params["params"]["critic"]}, marks=only_long),
    ],
)
def test_the_target_network_follows_slowly(name, critic):
    agent, state, _ = trained(name)
    batch = quick_jit(agent.batch)(jax.random.key(5), mixed.steps())
    after, _ = quick_jit(agent.update)(state, batch, jax.random.key(6))
    expected = jax.tree.map(
        lambda old, new: 0.9 * old + 0.1 * new, state.extra, critic(after.params)
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), after.extra, expected
    )
    fresh = quick_jit(agent.init)(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, fresh.extra, critic(fresh.params))


@pytest.mark.parametrize(
    ("module", "settings"),
    [
        pytest.param(dt, dt.Settings, marks=only_long),
        (leap, functools.partial(leap.Settings, masking="random", end=False, returns=True)),
    ],
    ids=["dt", "leap"],
)
def test_it_does_what_leads_to_the_return_that_is_asked_for(module, settings):
    """Of walks that end well and walks that never do, it follows those that gave as much."""
    model = ModelConfig("leapjax", layers=1, heads=2, width=32, dropout=0.0)
    learn = TrainingConfig(
        300, batch=64, warmup=30, learning_rate=3e-3, weight_decay=0.0, windows="step"
    )
    rng = np.random.default_rng(0)
    walks = [mixed.walk(rng, int(x), share, 6) for x in mixed.PLACES for share in (0.0, 1.0)]
    data = mixed.windows.concatenate(walks)
    agents = {
        target: module.make_agent(
            Setup(mixed.DOMAIN, 2, 1, model, learn, settings(target_return=target))
        )
        for target in (1.0, 0.0)
    }
    state, _ = toy.learn(agents[1.0], data, learn.steps)
    good, bad = (acts(agents[target], state.params, 2) for target in (1.0, 0.0))
    np.testing.assert_array_equal(good, mixed.best_actions())
    np.testing.assert_array_equal(bad, np.where(good == LEFT, RIGHT, LEFT))


def test_the_return_that_is_wanted_is_less_by_what_was_given():
    """In units that do not saturate; where a demonstration tells the rest, that is taken."""
    given = mixed.contexts(3)._replace(rewards=jnp.array([1.0, 2.0, 4.0]))
    np.testing.assert_array_equal(returns.returns_to_go(given, jnp.float32(10)), [17, 16, 14, 10])
    domain = mixed.DOMAIN._replace(return_scale=4.0)
    settings = dt.Settings(target_return=10.0)
    wanted = returns.wanted(Setup(domain, 2, 1, ModelConfig(), TrainingConfig(), settings))
    context = mixed.contexts(2)._replace(rewards=jnp.array([1.0, 1.0]), return_so_far=2.0)
    np.testing.assert_allclose(wanted(context), np.array([10, 9, 8]) / 4)
    np.testing.assert_allclose(wanted(context, jnp.float32(5)), np.array([7, 6, 5]) / 4)


@pytest.mark.parametrize("module", MODULES.values(), ids=MODULES)
def test_longer_plans_are_refused(module):
    setup = Setup(mixed.DOMAIN, 0, 5, ModelConfig(), TrainingConfig(), module.Settings())
    with pytest.raises(UserError, match="--horizon 5: .* one action at a time"):
        module.make_agent(setup)


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        (bcq.Settings, {"threshold": -0.1}), (iql.Settings, {"expectile": 2.0}),
        (mopo.Settings, {"members": 1}), (mopo.Settings, {"real_share": 1.5}),
        (cql.Settings, {"alpha": -0.1}), (cql.Settings, {"discount": 1.1}),
        (qr_dqn.Settings, {"quantiles": 0}), (rem.Settings, {"q_heads": 0}),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(settings, options):
    (name,) = options
    with pytest.raises(ValueError, match=name):
        settings(**options)
