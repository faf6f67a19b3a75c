"""Encoding a batch of contexts equals encoding each alone, in values and gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from leapjax.agents.base import Setup, TrainingConfig
from leapjax.domains.babyai import repeats
from leapjax.domains.babyai.encoders import state_tokens
from leapjax.methods import find_method
from leapjax.models.config import ModelConfig
from leapjax.models.encoder import Encoder
from tests import mixed
from tests.parameters import random_state, scaled_like
from tests.programs import only_long
from tests.quick import quick_jit
from tests.test_models import SIDE, random_context

RUNS = np.array([[0, 0, 1, 1, 1], [2, 3, 3, 0, 0], [0, 0, 0, 0, 0]])


@pytest.mark.parametrize("size", [4, 16])
def test_equal_consecutive_elements_share_a_call(size):
    pair = jnp.array(RUNS[..., None] % 2), jnp.array(RUNS > 1)  # each hides some differences
    rows, weights, calls = jnp.array([2.0, 3.0, 5.0]), np.arange(15.0).reshape(3, 5), []

    def function(element, row, scale):
        number = element[0][0] + 2 * element[1]
        jax.debug.callback(lambda _: calls.append(1), row)
        return scale * (1 + number) * jnp.log(row)

    def gradient(map_all):
        def total(rows, scale):
            return (weights * map_all(rows, lambda *given: function(*given, scale))).sum()

        return quick_jit(jax.value_and_grad(total, argnums=(0, 1)))(rows, 1.5)

    found = gradient(lambda rows, function: repeats.map_repeats(function, pair, rows, size))
    jax.effects_barrier()
    computed = len(calls)
    expected = gradient(lambda rows, f: jax.vmap(jax.vmap(f, (0, None)))(pair, rows))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5), found, expected)
    assert computed == 2 * size * -(-6 // size)  # 6 runs, in whole parts; the gradient calls again


def contexts(past):
    """Makes a batch: the second context has equal states, and the third has equal past states.

    Blank states would be divided by a norm near zero: rounding errors have large gradients there.
    """
    each = [random_context(seed, past) for seed in range(4)]

    def repeat(place):
        return jax.tree.map(lambda x: np.stack([x] * past), each[place].observation)

    each[1], each[2] = each[1]._replace(past=repeat(1)), each[2]._replace(past=repeat(3))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


@pytest.mark.parametrize("differentiated", [False, pytest.param(True, marks=only_long)])
def test_batched_encoding_equals_encoding_each_context(differentiated, monkeypatch, past=3):
    monkeypatch.setattr(state_tokens, "AT_A_TIME", 16)
    encoder, batch = state_tokens.StateTokens(SIDE, 16).add_later_state(), contexts(past)
    one = jax.tree.map(lambda leaf: leaf[0], batch)
    params = scaled_like(jax.eval_shape(encoder.init, jax.random.key(0), one))
    weights = np.random.default_rng(0).normal(size=(4, past + 2, 16)).astype(np.float32)

    @jax.jit  # together, because rounding decides which of equal cells is the largest
    def encode_both_ways(params):
        def gradient(encode):
            return jax.grad(lambda params: (weights * jnp.tanh(encode(params))).sum())(params)

        def encode_each(params):
            return jax.vmap(functools.partial(encoder.apply, params))(batch)

        def encode_batched(params):
            return encoder.apply(params, batch, method="encode_batch")

        return [gradient(f) if differentiated else f(params) for f in (encode_each, encode_batched)]

    assert_close(*encode_both_ways(params))


def assert_close(found, expected):
    """Asserts that arrays are equal up to rounding, and not all tiny."""
    for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4 * np.abs(other).max())
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(expected)) > 1e-3


METHODS = ("bc", "dt", "bcq", "iql", "mopo", "plate", "qr_dqn", "leap", "classifier")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "bc" else only_long) for name in METHODS]
)
def test_microbatches_leave_a_training_step_unchanged(name, monkeypatch):
    """Compares metrics and the gradient of all parameters, the encoder's included."""
    method, key, encoded = find_method(name), jax.random.key(0), []
    horizon = 3 if name in ("leap", "plate", "classifier") else 1
    model = ModelConfig("paper", layers=1, heads=2, width=16, dropout=0.1)
    encode = Encoder.encode_batch

    def encode_batch(encoder, contexts):
        encoded.append(len(contexts.step))
        return encode(encoder, contexts)

    monkeypatch.setattr(Encoder, "encode_batch", encode_batch)

    def step(microbatch):
        training = TrainingConfig(batch=6, microbatch=microbatch)
        agent = method.make_agent(
            Setup(mixed.DOMAIN, 2, horizon, model, training, method.settings()), None
        )
        state = random_state(agent)
        batch = quick_jit(agent.batch)(key, mixed.steps(episodes=1))
        state, metrics = quick_jit(agent.update)(state, batch, key)
        return jax.device_get((optax.tree.get(state.optimizer, "mu"), metrics))

    found, expected = step(2), step(0)
    assert set(encoded) == {6}
    assert_close(found, expected)
    leaves = jax.tree.leaves_with_path(expected[0])
    table = [leaf for path, leaf in leaves if "Embed_0" in str(path)]
    assert table and all(np.abs(leaf).max() > 1e-7 for leaf in table)
