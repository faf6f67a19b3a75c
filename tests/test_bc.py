"""Behaviour cloning learns what the demonstrator does, and acts by it."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax import batching
from leapjax.agents import bc
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.data import windows
from leapjax.models.encoder import Encoder
from leapjax.models.trajectory import ModelConfig
from leapjax.planners import GibbsConfig
from tests import toy
from tests.quick import quick_jit

TRAINING = TrainingConfig(steps=150, batch=16, warmup=10, learning_rate=1e-2, windows="step")
MODEL = ModelConfig(layers=1, heads=1, width=16, dropout=0.0)
SETUP = Setup(toy.DOMAIN, 2, 1, MODEL, TRAINING, bc.Settings())


@pytest.fixture(scope="module")
def trained():
    """An agent that was trained for a moment, its parameters and the last metrics."""
    agent = bc.make_agent(SETUP)
    data = windows.concatenate(toy.demonstrations())
    state, metrics = toy.learn(agent, data, TRAINING.steps)
    return agent, state.params, metrics


def contexts():
    """Every place of the line but its middle, without a past."""
    places = np.array([x for x in range(-toy.FARTHEST, toy.FARTHEST + 1) if x])
    states = np.stack([toy.observe(place) for place in places])
    data = windows.concatenate(toy.demonstrations())
    blank = windows.window(jax.tree.map(jnp.asarray, data), 0, 2, 1, toy.END).context
    many = jax.tree.map(lambda leaf: np.stack([leaf] * len(places)), blank)
    return places, many._replace(observation=states)


def test_it_does_what_the_demonstrator_did(trained):
    agent, params, metrics = trained
    assert metrics[0]["loss"] > 0.3 > 0.05 > metrics[-1]["loss"]
    assert metrics[-1]["accuracy"] == 1
    places, given = contexts()
    planner = batching.compile_planner(agent.energy, GibbsConfig(1, 1, temperature=0.0))
    plans = planner(params, jax.random.split(jax.random.key(0), len(places)), given)
    expected = np.where(places > 0, toy.LEFT, toy.RIGHT)
    np.testing.assert_array_equal(plans.actions[:, 0], expected)


def test_its_energy_is_minus_the_logits_and_the_end_is_never_chosen(trained):
    agent, params, _ = trained
    _, given = contexts()
    context = jax.tree.map(lambda leaf: leaf[0], given)
    memory = quick_jit(agent.energy.encode)(params, context)
    (energies,) = quick_jit(agent.energy.conditional)(
        params, memory, np.array([toy.END]), np.array([0])
    )
    np.testing.assert_array_equal(energies, [*-memory["logits"][-1], np.inf])


class States(Encoder):
    """A token for each state of a context, as the paper's encoder has."""

    @nn.compact
    def __call__(self, context):
        states = jnp.concatenate([context.past, context.observation[None]])
        return nn.Dense(MODEL.width)(states)


@pytest.mark.parametrize(("architecture", "targets"), [("paper", 3), ("leapjax", 1)])
def test_the_loss_is_the_cross_entropy_of_the_actions_that_are_known(architecture, targets):
    """Of every state of a context, or of the last one; not of what was before the episode."""
    encoders = {**toy.DOMAIN.encoders, "paper": lambda model, context: States()}
    domain = toy.DOMAIN._replace(encoders=encoders)
    model = dataclasses.replace(MODEL, architecture=architecture)
    agent = bc.make_agent(SETUP._replace(domain=domain, model=model))
    data = jax.tree.map(jnp.asarray, windows.concatenate(toy.demonstrations()))
    batch = quick_jit(agent.batch)(jax.random.key(2), data)
    state = quick_jit(agent.init)(jax.random.key(0))
    memory = quick_jit(jax.vmap(agent.energy.encode, (None, 0)))(state.params, batch.context)
    likelihoods = np.asarray(jax.nn.log_softmax(memory["logits"]))  # [B, P, A - 1]
    assert likelihoods.shape[1] == targets
    losses = []
    for rows, past, action in zip(likelihoods, batch.context.actions, batch.actions, strict=True):
        done = [*past.tolist(), int(action[0])][-targets:]
        known = [row[a] for row, a in zip(rows, done, strict=True) if a < toy.END]
        losses.append(-np.mean(known))
    assert (np.asarray(batch.context.actions) > toy.END).any()  # some had not begun
    _, metrics = quick_jit(agent.update)(state, batch, jax.random.key(3))
    assert metrics["loss"] == pytest.approx(np.mean(losses), rel=1e-4)
