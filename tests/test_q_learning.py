"""Methods that learn Q-values alone: conservative, distributional, and an ensemble's."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax import training
from leapjax.agents import cql, qr_dqn, rem
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.errors import UserError
from leapjax.models.trajectory import ModelConfig
from leapjax.types import Agent, TrainState
from tests import mixed
from tests.programs import only_long
from tests.quick import quick_jit
from tests.toy import LEFT, RIGHT, WAIT

MODULES = {"cql": cql, "qr_dqn": qr_dqn, "rem": rem}
QUICKLY = {"discount": 0.9, "target_rate": 0.1}
# Without waiting, which nobody does in the data: what is not there has any value at all, and
# only CQL knows what to do about that.
COVERED = mixed.DOMAIN._replace(actions=("left", "right", "end"))
TRAINED = {
    # Far from the middle a wrong step costs a tenth: the conservative term must not cost more.
    "cql": (mixed.DOMAIN, cql.Settings(**QUICKLY, alpha=0.1)),
    "cql without": (mixed.DOMAIN, cql.Settings(**QUICKLY, alpha=0.0)),
    "qr_dqn": (COVERED, qr_dqn.Settings(**QUICKLY, quantiles=8)),
    "rem": (COVERED, rem.Settings(**QUICKLY, q_heads=8)),
}


class Trained(NamedTuple):
    agent: Agent
    step: training.TrainStep
    state: TrainState
    metrics: list


@functools.cache
def data():
    return mixed.steps()


@functools.cache
def trained(case):
    """An agent after a moment of training on walks that go wrong more often than right."""
    domain, settings = TRAINED[case]
    model = ModelConfig("leapjax", layers=1, heads=1, width=32, dropout=0.0)
    learn = TrainingConfig(
        300, batch=64, warmup=10, learning_rate=5e-3, weight_decay=0.0, windows="step"
    )
    agent = MODULES[case.split()[0]].make_agent(Setup(domain, 0, 1, model, learn, settings))
    step, metrics = training.make_train_step(agent), []
    state = training.train(
        step, quick_jit(agent.init)(jax.random.key(0)), data(), jax.random.key(1), learn.steps,
        lambda done, state, means: metrics.append(means),
    )  # fmt: skip
    return Trained(agent, step, state, metrics)


@functools.cache
def energies(case):
    """Of each action and the end, at each place."""
    agent, _, state, _ = trained(case)

    @jax.jit
    @jax.vmap
    def of_place(context):
        memory = agent.energy.encode(state.params, context)
        nothing = jnp.zeros(1, jnp.int32)
        return agent.energy.conditional(state.params, memory, nothing, nothing)[0]

    return np.asarray(of_place(mixed.contexts(0)))


@pytest.mark.parametrize("case", ["cql", "qr_dqn", pytest.param("rem", marks=only_long)])
def test_the_best_policy_is_found(case):
    found = energies(case)
    np.testing.assert_array_equal(found.argmin(axis=1), mixed.best_actions())
    assert np.isposinf(found[:, -1]).all()  # the end is never chosen
    assert all(np.isfinite(list(entry.values())).all() for entry in trained(case).metrics)


@pytest.mark.parametrize("case", ["cql without", "qr_dqn", "rem"])
def test_values_are_those_of_value_iteration(case):
    best, rows = mixed.best_actions(), np.arange(len(mixed.PLACES))
    q = -energies(case)
    found = np.stack([q[rows, best], q[rows, np.where(best == LEFT, RIGHT, LEFT)]], axis=1)
    np.testing.assert_allclose(found, mixed.best_values(0.9), atol=0.05)


def test_cql_keeps_low_what_the_data_do_not_hold():
    conservative, plain = -energies("cql"), -energies("cql without")
    assert (conservative[:, WAIT] < plain[:, WAIT] - 1).all()
    assert (conservative[:, WAIT] < conservative[:, [LEFT, RIGHT]].min(axis=1) - 1).all()
    best = mixed.best_values(0.9)[:, 0]
    assert (conservative[:, :WAIT].max(axis=1) < best).all()  # lower bounds


def test_the_conservative_term():
    q = jnp.log(jnp.array([[1.0, 2.0, 5.0], [4.0, 4.0, 8.0]]))
    taken = jnp.array([1, 2])
    np.testing.assert_allclose(cql.conservative(q, taken), np.log([8 / 2, 16 / 8]), rtol=1e-6)
    # It moves Q-values from what the soft policy does to what the data do.
    gradient = jax.grad(lambda q: cql.conservative(q, taken).sum())(q)
    expected = [[1 / 8, 2 / 8 - 1, 5 / 8], [1 / 4, 1 / 4, 1 / 2 - 1]]
    np.testing.assert_allclose(gradient, expected, rtol=1e-5)


def test_mixtures_are_random_and_convex():
    weights = jax.vmap(rem.mixture, (0, None))(jax.random.split(jax.random.key(0), 500), 8)
    assert (weights >= 0).all() and weights.shape == (500, 8)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 8, atol=0.01)
    assert (weights.std(axis=0) > 0.04).all()
    np.testing.assert_array_equal(rem.mixture(jax.random.key(1), 1), [1])


def test_the_target_network_follows_slowly():
    _, step, state, _ = trained("rem")
    after, _ = step(jax.tree.map(jnp.copy, state), data(), jax.random.key(5))
    expected = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, state.extra, after.params)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), after.extra, expected
    )


@pytest.mark.parametrize("name", list(MODULES))
def test_longer_plans_are_refused(name):
    setup = Setup(mixed.DOMAIN, 0, 5, ModelConfig(), TrainingConfig(), MODULES[name].Settings())
    with pytest.raises(UserError, match="a horizon of 5: .* one action at a time"):
        MODULES[name].make_agent(setup)


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        (cql.Settings, {"alpha": -0.1}), (cql.Settings, {"alpha": float("nan")}),
        (cql.Settings, {"alpha": float("inf")}), (cql.Settings, {"discount": 1.1}),
        (qr_dqn.Settings, {"quantiles": 0}), (qr_dqn.Settings, {"target_rate": -0.1}),
        (rem.Settings, {"q_heads": 0}), (rem.Settings, {"target_rate": float("nan")}),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(settings, options):
    (name,) = options
    with pytest.raises(ValueError, match=f"^{name} must be .*$") as refused:
        settings(**options)
    assert "\n" not in str(refused.value)
