"""What a network made of past states is kept from one decision to the next, and is the same."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from leapjax import methods
from leapjax.agents.learning import Setup, TrainingConfig
from leapjax.domain import Domain, blank_context, check_context
from leapjax.domains import find_domain
from leapjax.errors import UserError
from leapjax.models.trajectory import ModelConfig
from leapjax.planners import GibbsConfig
from leapjax.rollouts import History
from leapjax.types import nothing_encoded
from tests.parameters import random_parameters
from tests.programs import only_long
from tests.quick import quick_jit
from tests.recorder import Recorder

MODEL = ModelConfig("paper", layers=1, heads=2, width=16, dropout=0.0, attention="causal")
LEVELS = {"babyai": "GoToLocalS7N5", "atari": "Pong", "gymnasium": "CartPole-v1"}


@functools.cache
def level_of(name: str) -> Domain:
    domain = find_domain(name)
    return domain.make(LEVELS[name], domain.settings())


def episode(domain: Domain, length: int, steps: int, act: Callable[[History], np.ndarray]):
    """The history after each step of a random episode; `act` says what is known of states."""
    adapter, rng = domain.make_adapter(), np.random.default_rng(0)
    history = History(adapter.reset(3), length, domain.num_actions)
    for _ in range(steps):
        encoded = act(history)
        action = int(rng.integers(domain.num_actions - 1))
        found = adapter.step(action)
        if found.terminated or found.truncated:
            break
        history.advance(action, found.observation, found.reward, encoded)


@only_long
@pytest.mark.parametrize(
    ("name", "length"),
    [("babyai", 3), ("gymnasium", 3), ("atari", 1), ("atari", 2), ("atari", 3), ("atari", 6)],
)
def test_states_look_as_they_did_when_they_were_current(name, length):
    domain = level_of(name)
    encoder = domain.encoders["paper"](MODEL, length)
    params = quick_jit(encoder.init)(jax.random.key(0), blank_context(domain, length))
    encode = quick_jit(encoder.apply)
    known, moved = [], []

    def act(history):
        context = history.context()
        known.append(context.encoded is not None)
        tokens = np.asarray(encode(params, context))
        assert tokens.shape == (length + 1, MODEL.width)
        anew = np.asarray(encode(params, context._replace(encoded=None)))
        np.testing.assert_allclose(tokens, anew, rtol=1e-4, atol=1e-5)
        moved.append(np.ptp(tokens, axis=0).max())
        return tokens[1:]

    episode(domain, length, 9, act)
    assert known == [False] + [True] * 8
    assert moved[-1] > 1e-3  # states differ by more than that


def agent_of(method: str, domain: Domain, length: int, model: ModelConfig = MODEL):
    kind = methods.find_method(method)
    horizon = 2 if method == "leap" else 1
    settings = kind.settings()
    return kind.make_agent(Setup(domain, length, horizon, model, TrainingConfig(), settings), None)


@pytest.mark.parametrize(("method", "horizon"), [("leap", 2), ("dt", 1), ("mopo", 1)])
def test_a_method_keeps_what_its_encoder_made(method, horizon):
    domain = level_of("gymnasium")
    agent = agent_of(method, domain, 3)
    params, rng = random_parameters(agent, 0.3), np.random.default_rng(0)
    context = jax.tree.map(
        lambda x: rng.integers(0, 2, x.shape).astype(x.dtype), blank_context(domain, 3)
    )

    @jax.jit
    def look(context):
        memory = agent.energy.encode(params, context)
        actions, positions = jnp.zeros(horizon, int), jnp.arange(1)
        energies = agent.energy.conditional(params, memory, actions, positions)
        return agent.energy.encoded(memory), energies[0, :-1]

    made, energies = look(context)
    assert made.shape == (4, MODEL.width)
    kept, again = look(context._replace(encoded=made[:-1]))
    np.testing.assert_allclose(kept, made, atol=1e-5)
    np.testing.assert_allclose(again, energies, atol=1e-4)
    _, other = look(context._replace(encoded=-made[:-1]))  # it is read
    assert np.abs(other - energies).max() > 1e-3


@pytest.mark.parametrize(("architecture", "length"), [("leapjax", 3), ("paper", 0)])
def test_nothing_is_kept_where_there_is_nothing_to_gain(architecture, length):
    model = ModelConfig(architecture, layers=1, heads=2, width=16, dropout=0.0)
    energy = agent_of("bc", level_of("gymnasium"), length, model).energy
    assert energy.encoded is nothing_encoded


def told(planner: Recorder) -> list[bool]:
    """Whether a planner was told of past states, for each of its calls."""
    return [contexts.encoded is not None for contexts in planner.contexts]


def test_episodes_are_the_same_whether_states_are_kept_or_not():
    domain = level_of("gymnasium")
    agent = agent_of("leap", domain, 3)
    params = random_parameters(agent, 0.3)
    play = functools.partial(
        leap.evaluate, domain.make_adapter, [0, 1], params=params, context=3, max_steps=8
    )
    kept, anew = (
        Recorder(leap.compile_planner(energy, GibbsConfig(2, 2, temperature=1.0), (2,)))
        for energy in (agent.energy, agent.energy._replace(encoded=nothing_encoded))
    )
    played = [play(plan=plan, executed=1) for plan in (kept, anew)]
    assert told(kept) == [False] + [True] * 7 and told(anew) == [False] * 8
    for one, other in zip(kept.plans, anew.plans, strict=True):
        np.testing.assert_array_equal(one.actions, other.actions)
    assert len({plan.actions.tobytes() for plan in kept.plans}) > 1
    assert played[0].lengths.tolist() == played[1].lengths.tolist() == [8, 8]
    # Of what is seen while a plan of several actions is executed nothing is known.
    before = len(kept.plans)
    play(plan=kept, executed=2)
    assert len(kept.plans) > before + 3 and not any(told(kept)[before:])


def test_views_see_anew_and_constraints_keep():
    domain = level_of("gymnasium")
    energy = agent_of("bc", domain, 2).energy
    assert leap.view(energy, lambda context: context).encoded is nothing_encoded
    assert leap.compose([energy, energy]).encoded is nothing_encoded
    constrained = leap.constrain(energy, lambda context, actions: jnp.zeros(()))
    assert constrained.encoded(({"tokens": 7}, None)) == 7


def test_states_encoded_for_another_context_are_refused():
    domain = level_of("gymnasium")
    context = blank_context(domain, 3)
    with pytest.raises(UserError, match="2 past states are encoded, but this network .* for 3"):
        check_context(context._replace(encoded=np.zeros((2, 16))), domain, 3)
    check_context(context._replace(encoded=np.zeros((3, 16))), domain, 3)
