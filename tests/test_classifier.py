"""The sequence classifier: what it is trained on, what it learns, how one plans with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax import batching
from leapjax.agents import classifier
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.data import windows
from leapjax.models.trajectory import ModelConfig
from leapjax.planners import GibbsConfig
from tests import toy
from tests.quick import quick_jit

NUM_ACTIONS, END = toy.DOMAIN.num_actions, toy.END
TRAINING = TrainingConfig(steps=150, batch=16, warmup=10, learning_rate=1e-2)
MODEL = ModelConfig(layers=1, heads=1, width=16)
SETUP = Setup(toy.DOMAIN, 0, 4, MODEL, TRAINING, classifier.Settings())


def test_corruption_is_as_many_other_actions_as_it_says():
    actions = jnp.array([0, 2, 2, END])
    keys = jax.random.split(jax.random.key(0), 4000)
    corrupt = quick_jit(
        jax.vmap(
            lambda key, imitated: classifier.corrupt(key, actions, imitated, NUM_ACTIONS), (0, None)
        )
    )
    corrupted, degrees = corrupt(keys, jnp.ones(4, bool))
    assert ((corrupted >= 0) & (corrupted < NUM_ACTIONS)).all()
    np.testing.assert_allclose((corrupted != actions).mean(axis=1), degrees)
    # Every degree is as likely, every position too, and every other action.
    counts = np.bincount(np.round(degrees * 4).astype(int), minlength=5)
    np.testing.assert_allclose(counts / 4000, 0.2, atol=0.03)
    np.testing.assert_allclose((corrupted != actions).mean(axis=0), 0.5, atol=0.04)
    changed = corrupted[:, 1][corrupted[:, 1] != 2]
    shares = np.bincount(changed, minlength=NUM_ACTIONS) / len(changed)
    expected = np.where(np.arange(NUM_ACTIONS) == 2, 0, 1 / (NUM_ACTIONS - 1))
    np.testing.assert_allclose(shares, expected, atol=0.04)
    # What is not to be imitated is corrupted, replaced or not.
    imitated = jnp.array([False, True, False, True])
    corrupted, degrees = corrupt(keys, imitated)
    np.testing.assert_allclose(((corrupted != actions) | ~imitated).mean(axis=1), degrees)


@pytest.fixture(scope="module")
def trained():
    """An agent that was trained for a moment, its parameters, a batch and the losses."""
    agent = classifier.make_agent(SETUP)
    data = jax.tree.map(jnp.asarray, windows.concatenate(toy.demonstrations()))
    state, metrics = toy.learn(agent, data, TRAINING.steps)
    losses = [means["loss"] for means in metrics]
    return agent, state.params, jax.jit(agent.batch)(jax.random.key(2), data), losses


def test_it_learns_how_corrupted_a_plan_is(trained):
    agent, params, batch, losses = trained
    # Always saying 1/2 has a squared error of 1/8.
    assert losses[-1] < 0.06 < losses[0]
    energy = agent.energy
    keys = jax.random.split(jax.random.key(3), 16)

    @jax.jit
    def energies(context, actions, key):
        memory = energy.encode(params, context)
        shuffled = jax.random.randint(key, actions.shape, 0, END)
        return energy.total(params, memory, actions), energy.total(params, memory, shuffled)

    clean, random = jax.vmap(energies)(batch.context, batch.actions, keys)
    assert (clean < random).mean() > 0.8


def test_one_plans_with_it_as_with_any_energy(trained):
    agent, params, batch, _ = trained
    assert not agent.energy.accepts_mask
    keys = batching.plan_keys(0, np.arange(16), np.zeros(16, int))
    config = GibbsConfig(4, 13, order="sequential", score_trace=True)
    plan = batching.compile_planner(agent.energy, config, (16,))(params, keys, batch.context)
    energies = np.asarray(plan.trace_energies)
    # Its conditional is its total with each action tried, so greedy steps never raise it.
    assert np.isfinite(energies).all()
    assert (np.diff(energies, axis=1) <= 1e-5).all()
    assert (plan.actions[:, 0] != END).all()
