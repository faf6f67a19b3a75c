"""PlaTe predicts states and actions in turn, and finds plans by beam search."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.agents import plate
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.batching import compile_planner
from leapjax.data import windows
from leapjax.models.config import ModelConfig
from leapjax.planners import BeamConfig
from tests import mixed, toy
from tests.parameters import random_parameters
from tests.programs import only_long
from tests.quick import quick_jit

HORIZON = 4
POSITIONS = np.arange(HORIZON)
EACH_ARCHITECTURE = pytest.mark.parametrize(
    ("architecture", "past"),
    [pytest.param("leapjax", 0, marks=only_long), ("leapjax", 1), ("paper", 2)],
)


def make_setup(architecture, past, steps=1, **options):
    model = ModelConfig(architecture, layers=1, heads=2, width=32, dropout=0.0, **options)
    learn = TrainingConfig(
        steps, batch=64, warmup=20, learning_rate=3e-3, weight_decay=0.0, windows="step"
    )
    return Setup(mixed.DOMAIN, past, HORIZON, model, learn, plate.Settings())


def make_data():
    return jax.tree.map(jnp.asarray, windows.concatenate(toy.demonstrations()))


class Untrained:
    """A network with random parameters, some contexts, and the energies of plans."""

    def __init__(self, architecture, past):
        setup = make_setup(architecture, past)
        self.agent = plate.make_agent(setup)
        self.params = random_parameters(self.agent)
        self.contexts = quick_jit(self.agent.batch)(jax.random.key(2), make_data()).context
        first = jax.tree.map(lambda x: x[0], self.contexts)
        self.context = windows.context_at(first, 0, past)
        module = plate.AlternatingModel(setup.model, setup.sizes, setup.make_encoder())
        self.call = quick_jit(
            lambda method, *inputs: module.apply(self.params, *inputs, method=method),
            static_argnums=0,
        )
        self.memory = quick_jit(self.agent.energy.encode)(self.params, self.context)
        conditional = functools.partial(quick_jit(self.agent.energy.conditional), self.params)
        self.energies = functools.partial(conditional, self.memory)


untrained = functools.cache(Untrained)


@EACH_ARCHITECTURE
def test_later_states_of_a_window_are_encoded_like_current_states(architecture, past):
    """The targets of predicted states equal the encodings of those states as observed."""
    network = untrained(architecture, past)
    unrolled = jax.tree.map(lambda x: x[1], network.contexts)
    second = jax.tree.map(lambda x: x[1:2], network.contexts)
    (tokens,) = network.call("encode_batch", second)
    states, actions = network.call("encode_unrolled", unrolled, tokens)
    shown = past if architecture == "paper" else 0
    assert states.shape[0] == shown + HORIZON and actions.shape == (shown + HORIZON - 1,)
    for place in range(HORIZON):
        context = windows.context_at(unrolled, place, past)
        seen, before = network.call("encode", context)
        np.testing.assert_allclose(seen[-1], states[shown + place], rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(before, actions[place : place + shown])


@EACH_ARCHITECTURE
def test_incremental_decoding_equals_passes_over_all_tokens(architecture, past):
    """Compares cached energies with passes over all tokens, predicted states included."""
    network, plan = untrained(architecture, past), jnp.array([0, 1, 2, 0])
    states, before = network.call("encode", network.context)
    between, read = jnp.concatenate([before, plan[:-1]]), functools.partial(network.call, "read")
    states = jnp.concatenate([states, jnp.zeros((HORIZON - 1, states.shape[1]))])
    for place in range(HORIZON - 1):
        _, predicted = read(states, between)
        states = states.at[place - HORIZON + 1].set(predicted[place])
    expected = -jax.nn.log_softmax(read(states, between)[0])
    found = network.energies(plan, POSITIONS)
    np.testing.assert_allclose(found[1:], expected[1:], rtol=1e-3, atol=1e-3)
    assert np.isposinf(found[0, toy.END])
    # No energy depends on later actions, nor on the other positions to score.
    for place in range(HORIZON):
        (alone,) = network.energies(np.where(place < POSITIONS, 1, plan), np.array([place]))
        np.testing.assert_allclose(alone, found[place], rtol=1e-4, atol=1e-4)


def test_only_the_end_follows_an_end():
    """Training skips positions after an end, so the rest of an ended plan costs 0."""
    network = untrained("leapjax", 0)
    found = np.asarray(network.energies(np.array([0, toy.END, 1, toy.END]), POSITIONS))
    assert np.isfinite(found[0, : toy.END]).all() and np.isfinite(found[1]).all()
    expected = np.where(np.arange(toy.END + 1) == toy.END, 0.0, np.inf)
    np.testing.assert_array_equal(found[2:], np.stack([expected, expected]))
    ended = jnp.array([0, toy.END, toy.END, toy.END])
    total = quick_jit(network.agent.energy.total)(network.params, network.memory, ended)
    assert total == pytest.approx(found[0, 0] + found[1, toy.END], rel=1e-5)


def test_energies_in_bfloat16_are_close_to_float32():
    """The cache of earlier tokens has the precision of the tokens."""
    network, plan = untrained("leapjax", 0), jnp.array([0, 1, 2, 0])
    energy = plate.make_agent(make_setup("leapjax", 0, dtype="bfloat16")).energy
    memory = quick_jit(energy.encode)(network.params, network.context)
    low = quick_jit(energy.conditional)(network.params, memory, plan, POSITIONS)[:, :-1]
    high = network.energies(plan, POSITIONS)[:, :-1]
    assert 0 < np.abs(low - high).max() < 0.05 * np.abs(high).max()


@only_long
def test_plans_follow_the_demonstrator():
    setup = make_setup("leapjax", 0, steps=300)
    agent = plate.make_agent(setup)
    state, metrics = toy.learn(agent, make_data(), setup.training.steps)
    assert metrics[-1]["accuracy"] == 1 and metrics[-1]["state_error"] < 0.02
    keys = jax.random.split(jax.random.key(0), len(mixed.PLACES))
    planner = compile_planner(agent.energy, BeamConfig(HORIZON, beams=3, score=True))
    plans = planner(state.params, keys, mixed.contexts(0))
    for place, plan, energy in zip(mixed.PLACES, plans.actions, plans.energy, strict=True):
        steps = min(abs(place), HORIZON)
        expected = [mixed.towards(place)] * steps + [toy.END]
        assert plan[: steps + 1].tolist() == expected[:HORIZON]
        assert steps < HORIZON or energy < 0.1  # a likelihood near 1
