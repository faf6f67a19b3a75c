"""Caching the tokens of past states between plans does not change plans."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from leapjax import methods
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.domain import Domain, blank_context
from leapjax.domains import find_domain
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig
from leapjax.planners import GibbsConfig
from leapjax.rollouts import History
from tests.parameters import random_parameters
from tests.programs import only_long
from tests.quick import quick_jit
from tests.recorder import Recorder

MODEL = ModelConfig("paper", layers=1, heads=2, width=16, dropout=0.0, attention="causal")
KEY = jax.random.key(0)
LEVELS = {"babyai": "GoToLocalS7N5", "atari": "Pong", "gymnasium": "CartPole-v1"}


@functools.cache
def build_domain(name: str) -> Domain:
    domain = find_domain(name)
    return domain.make(LEVELS[name], domain.settings())


@only_long
@pytest.mark.parametrize(("name", "length"), [("babyai", 3), ("gymnasium", 3), ("atari", 6)])
def test_incremental_encoding_returns_the_tokens_of_full_encoding(name, length):
    domain, rng, cached_tokens, spreads = build_domain(name), np.random.default_rng(0), None, []
    encoder = domain.encoders["paper"](MODEL, length)
    params = quick_jit(encoder.init)(KEY, blank_context(domain, length))
    encode_next = quick_jit(functools.partial(encoder.apply, method="encode_next"))
    adapter = domain.make_adapter()
    history = History(adapter.reset(3), length, domain.num_actions)
    for _ in range(9):
        tokens = np.asarray(encode_next(params, history.context(), cached_tokens))
        assert tokens.shape == (length + 1, MODEL.width)
        uncached = np.asarray(quick_jit(encoder.apply)(params, history.context()))
        np.testing.assert_allclose(tokens, uncached, rtol=1e-4, atol=1e-5)
        cached_tokens = tokens[1:]
        spreads.append(np.ptp(tokens, axis=0).max())
        action = int(rng.integers(domain.num_actions - 1))
        transition = adapter.step(action)
        history.advance(action, transition.observation, transition.reward)
    assert spreads[-1] > 1e-3  # states differ by more than the tolerance


def build_agent(method: str, length: int, model: ModelConfig = MODEL):
    kind = methods.find_method(method)
    horizon = 2 if method == "leap" else 1
    settings = kind.settings()
    setup = Setup(build_domain("gymnasium"), length, horizon, model, TrainingConfig(), settings)
    return kind.make_agent(setup, None)


@pytest.mark.parametrize(
    "method", ["leap", "mopo", *(pytest.param(name, marks=only_long) for name in ("dt", "iql"))]
)
def test_caches_are_read_and_do_not_change_energies(method):
    agent = build_agent(method, 3)
    params, rng = random_parameters(agent, 0.3), np.random.default_rng(0)
    blank = blank_context(build_domain("gymnasium"), 3)
    context = jax.tree.map(lambda x: rng.integers(0, 2, x.shape).astype(x.dtype), blank)
    before = context._replace(  # one action earlier
        observation=context.past[-1], past=np.concatenate([context.past[:1], context.past[:-1]])
    )

    @jax.jit
    def score_actions(memory):
        actions = jnp.zeros(2 if method == "leap" else 1, int)
        return agent.energy.conditional(params, memory, actions, jnp.arange(1))[0, :-1]

    encode_next = quick_jit(functools.partial(agent.encode_next, params))
    _, cache = encode_next(before, None)
    uncached = score_actions(encode_next(context, None)[0])
    np.testing.assert_allclose(score_actions(encode_next(context, cache)[0]), uncached, atol=1e-4)
    full = quick_jit(agent.energy.encode)(params, context)
    np.testing.assert_allclose(score_actions(full), uncached, atol=1e-5)
    other, _ = encode_next(context, jax.tree.map(jnp.negative, cache))
    assert np.abs(score_actions(other) - uncached).max() > 1e-3


@pytest.mark.parametrize(("architecture", "length"), [("leapjax", 3), ("paper", 0)])
def test_encoders_without_tokens_of_past_states_have_no_cache(architecture, length):
    model = ModelConfig(architecture, layers=1, heads=2, width=16, dropout=0.0)
    assert build_agent("bc", length, model).encode_next is None


def test_caches_do_not_change_episodes():
    agent = build_agent("leap", 3)
    config, params = GibbsConfig(2, 2, temperature=1.0), random_parameters(agent, 0.3)
    cached, uncached = (
        Recorder(leap.compile_planner(agent.energy, config, (2,), encode_next=encode_next))
        for encode_next in (agent.encode_next, None)
    )
    episodes = [
        leap.evaluate(
            build_domain("gymnasium").make_adapter, [0, 1], plan, params,
            context=3, max_steps=8, executed=1,
        )
        for plan in (cached, uncached)
    ]  # fmt: skip
    assert [cache is not None for cache in cached.caches] == [False] + [True] * 7
    assert not any(cache is not None for cache in uncached.caches)
    for one, other in zip(cached.plans, uncached.plans, strict=True):
        np.testing.assert_array_equal(one.actions, other.actions)
    assert len({plan.actions.tobytes() for plan in cached.plans}) > 1
    assert episodes[0].lengths.tolist() == episodes[1].lengths.tolist() == [8, 8]
    with pytest.raises(UserError, match="cache must have a row for each of the 1 contexts"):
        context = jax.tree.map(lambda x: x[:1], cached.contexts[-1])
        cached.plan.plan_next(params, jax.random.split(KEY, 1), context, cached.caches[-1])
