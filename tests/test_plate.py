"""PlaTe predicts states and actions in turn, and finds plans by beam search."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.agents import plate
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.batching import compile_planner
from leapjax.data import windows
from leapjax.models.trajectory import ModelConfig
from leapjax.planners import BeamConfig
from tests import mixed, toy
from tests.parameters import random_parameters
from tests.programs import only_long
from tests.quick import quick_jit

HORIZON = 4
EACH_ARCHITECTURE = pytest.mark.parametrize(
    ("architecture", "past"), [("leapjax", 0), ("leapjax", 1), ("paper", 2)]
)


def setup_of(architecture, past, steps=1):
    model = ModelConfig(architecture, layers=1, heads=2, width=32, dropout=0.0)
    learn = TrainingConfig(
        steps, batch=64, warmup=20, learning_rate=3e-3, weight_decay=0.0, windows="step"
    )
    return Setup(mixed.DOMAIN, past, HORIZON, model, learn, plate.Settings())


def data():
    return jax.tree.map(jnp.asarray, windows.concatenate(toy.demonstrations()))


@functools.cache
def untrained(architecture, past):
    """An agent, parameters that are all random, and windows."""
    agent = plate.make_agent(setup_of(architecture, past))
    batch = quick_jit(agent.batch)(jax.random.key(2), data())
    return agent, random_parameters(agent), jax.tree.map(np.asarray, batch)


def network(architecture, past):
    setup = setup_of(architecture, past)
    return plate.AlternatingModel(setup.model, setup.sizes, setup.make_encoder())


@EACH_ARCHITECTURE
def test_an_action_depends_on_those_before_it_alone(architecture, past):
    agent, params, batch = untrained(architecture, past)
    context = windows.context_at(jax.tree.map(lambda x: x[0], batch.context), 0, past)
    everywhere = np.arange(HORIZON)
    memory = quick_jit(agent.energy.encode)(params, context)
    energies = quick_jit(agent.energy.conditional)
    before = np.asarray(energies(params, memory, np.zeros(HORIZON, np.int32), everywhere))
    for changed in range(HORIZON):
        plan = np.arange(HORIZON, dtype=np.int32) == changed
        after = energies(params, memory, plan.astype(np.int32), everywhere)
        with np.errstate(invalid="ignore"):
            differs = np.nanmax(np.abs(np.asarray(after) - before), axis=1) > 1e-4
        assert differs.tolist() == [place > changed for place in range(HORIZON)]
    # One at a time as all together, although fewer states are then predicted.
    for place in range(HORIZON):
        (alone,) = energies(params, memory, np.zeros(HORIZON, np.int32), np.array([place]))
        np.testing.assert_allclose(alone, before[place], rtol=1e-4, atol=1e-4)
    assert np.isposinf(before[0, toy.END])


@EACH_ARCHITECTURE
def test_the_future_is_encoded_as_the_present_is(architecture, past):
    """State by state: what is predicted is what would be seen."""
    _, params, batch = untrained(architecture, past)
    module = network(architecture, past)
    unrolled = jax.tree.map(lambda x: x[1], batch.context)
    (tokens,) = module.apply(
        params, jax.tree.map(lambda x: x[1:2], batch.context), method="encode_batch"
    )
    states, actions = module.apply(params, unrolled, tokens, method="encode_unrolled")
    shown = past if architecture == "paper" else 0
    assert states.shape[0] == shown + HORIZON and actions.shape == (shown + HORIZON - 1,)
    for place in range(HORIZON):
        context = windows.context_at(unrolled, place, past)
        seen, before = module.apply(params, context, method="encode")
        np.testing.assert_allclose(seen[-1], states[shown + place], rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(before, actions[place : place + shown])


@EACH_ARCHITECTURE
def test_one_token_at_a_time_says_what_all_together_say(architecture, past):
    """Plans with predicted states, against passes over all tokens with those states."""
    agent, params, batch = untrained(architecture, past)
    module = network(architecture, past)
    context = windows.context_at(jax.tree.map(lambda x: x[0], batch.context), 0, past)
    plan = jnp.array([0, 1, 2, 0])
    states, before = module.apply(params, context, method="encode")
    between = jnp.concatenate([before, plan[:-1]])
    read = quick_jit(functools.partial(module.apply, method="read"))
    states = jnp.concatenate([states, jnp.zeros((HORIZON - 1, states.shape[1]))])
    for place in range(HORIZON - 1):
        _, led = read(params, states, between)
        states = states.at[place - HORIZON + 1].set(led[place])
    expected = -jax.nn.log_softmax(read(params, states, between)[0])
    memory = agent.energy.encode(params, context)
    found = agent.energy.conditional(params, memory, plan, jnp.arange(HORIZON))
    np.testing.assert_allclose(found[1:], expected[1:], rtol=1e-3, atol=1e-3)


def test_nothing_follows_an_end():
    """Past it nothing is learned, so nothing is asked: a plan that ended costs no more."""
    agent, params, batch = untrained("leapjax", 0)
    context = windows.context_at(jax.tree.map(lambda x: x[0], batch.context), 0, 0)
    memory = quick_jit(agent.energy.encode)(params, context)
    energies = quick_jit(agent.energy.conditional)
    plan = np.array([0, toy.END, 1, toy.END], np.int32)
    found = np.asarray(energies(params, memory, plan, np.arange(HORIZON)))
    assert np.isfinite(found[0, : toy.END]).all() and np.isfinite(found[1]).all()
    expected = np.where(np.arange(toy.END + 1) == toy.END, 0.0, np.inf)
    np.testing.assert_array_equal(found[2:], np.stack([expected, expected]))
    ended = jnp.array([0, toy.END, toy.END, toy.END])
    first = found[0, 0] + found[1, toy.END]
    assert agent.energy.total(params, memory, ended) == pytest.approx(first, rel=1e-5)


def test_it_plans_in_bfloat16():
    """What is kept of earlier tokens has the precision of the tokens."""
    _, params, batch = untrained("leapjax", 0)
    context = windows.context_at(jax.tree.map(lambda x: x[0], batch.context), 0, 0)

    def energies_in(dtype):
        setup = setup_of("leapjax", 0)
        setup = setup._replace(model=dataclasses.replace(setup.model, dtype=dtype))
        energy = plate.make_agent(setup).energy

        def energies(params, context):
            plan = jnp.array([0, 1, 2, 0])
            return energy.conditional(
                params, energy.encode(params, context), plan, jnp.arange(HORIZON)
            )

        return np.asarray(quick_jit(energies)(params, context))[:, :-1]

    low, high = energies_in("bfloat16"), energies_in("float32")
    assert 0 < np.abs(low - high).max() < 0.05 * np.abs(high).max()


@pytest.fixture(scope="module")
def trained():
    setup = setup_of("leapjax", 0, steps=300)
    agent = plate.make_agent(setup)
    state, metrics = toy.learn(agent, data(), setup.training.steps)
    return agent, state.params, metrics


@only_long
def test_plans_are_the_demonstrators_ways(trained):
    agent, params, metrics = trained
    assert metrics[-1]["accuracy"] == 1 and metrics[-1]["state_error"] < 0.02
    keys = jax.random.split(jax.random.key(0), len(mixed.PLACES))
    planner = compile_planner(agent.energy, BeamConfig(HORIZON, beams=3, score=True))
    plans = planner(params, keys, mixed.contexts(0))
    for place, plan, energy in zip(mixed.PLACES, plans.actions, plans.energy, strict=True):
        steps = min(abs(place), HORIZON)
        assert plan[:steps].tolist() == [mixed.towards(place)] * steps
        if steps < HORIZON:
            assert plan[steps] == toy.END
            continue
        assert energy < 0.1  # a likelihood near 1


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="state_weight must be at least 0"):
        plate.Settings(state_weight=-1.0)
