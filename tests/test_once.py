"""What repeats is computed once: as if each had been computed, values and gradients."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from leapjax.agents import learning
from leapjax.agents.learning import Setup, TrainingConfig
from leapjax.domains.babyai import encoders
from leapjax.methods import find_method
from leapjax.models import once
from leapjax.models.trajectory import ModelConfig
from tests import mixed
from tests.parameters import random_state
from tests.programs import only_long
from tests.quick import quick_jit
from tests.test_models import SIDE, random_context

RUNS = np.array([[0, 0, 1, 1, 1], [2, 3, 3, 0, 0], [0, 0, 0, 0, 0]])


def test_what_repeats_the_one_before_is_found():
    pair = RUNS[..., None] % 2, (RUNS > 1).astype(np.float32)  # either alone hides a difference
    first, count, which = jax.jit(once.runs)(pair)
    assert count == 6
    np.testing.assert_array_equal(first[:6], [0, 2, 5, 6, 8, 10])
    np.testing.assert_array_equal(which, [[0, 0, 1, 1, 1], [2, 3, 3, 4, 4], [5, 5, 5, 5, 5]])
    np.testing.assert_array_equal(RUNS.reshape(-1)[first][which], RUNS)


@pytest.mark.parametrize("size", [1, 3, 16])
@pytest.mark.parametrize("count", [0, 1, 6, 7])
def test_only_the_first_are_computed_and_differentiated(count, size):
    things = jnp.arange(7)
    rows = jnp.linspace(0.5, 2, 7).at[count:].set(-1)  # whose logarithm is not a number
    weights = jnp.array([2.0, 3, 5, 7, 11, 13, 17]) * (things < count)

    @quick_jit
    def found(rows, scale):
        def total(rows, scale):
            each = once.of_first(
                lambda thing, row: scale * thing * jnp.log(row), things, rows, count, size
            )
            return jnp.where(weights > 0, weights * each, 0).sum(), each

        return jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(rows, scale)

    (_, each), (by_rows, by_scale) = found(rows, 1.5)
    assert each.shape == (7,)
    known = slice(0, count)
    logarithms, numbers = np.log(rows[known]), np.arange(count)
    np.testing.assert_allclose(each[known], 1.5 * numbers * logarithms, rtol=1e-6)
    expected = 1.5 * numbers * weights[known] / rows[known]
    np.testing.assert_allclose(by_rows[known], expected, rtol=1e-6)
    if count % size == 0:  # otherwise the last part holds more than was asked for
        np.testing.assert_array_equal(by_rows[count:], 0)
        expected = (weights[known] * numbers * logarithms).sum()
        np.testing.assert_allclose(by_scale, expected, rtol=1e-6)


def contexts(past):
    """A batch of them: all states of one are the same, and the past ones of another.

    Not blank ones: they are normalised by next to nothing, so that rounding has large gradients.
    """
    each = [random_context(seed, past) for seed in range(4)]

    def standing(place):
        return jax.tree.map(lambda x: np.stack([x] * past), each[place].observation)

    each[1], each[2] = each[1]._replace(past=standing(1)), each[2]._replace(past=standing(3))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


@pytest.mark.parametrize("differentiated", [False, pytest.param(True, marks=only_long)])
def test_all_states_of_a_batch_are_seen_as_each_is(differentiated, past=3):
    encoder, batch = encoders.StateTokens(SIDE, 16), contexts(past)
    one = jax.tree.map(lambda leaf: leaf[0], batch)
    params = quick_jit(functools.partial(encoder.init, ahead=True))(jax.random.key(0), one)
    weights = np.random.default_rng(0).normal(size=(4, past + 2, 16)).astype(np.float32)

    def alone(params):
        return jax.vmap(lambda context: encoder.apply(params, context, ahead=True))(batch)

    def together(params):
        return encoder.apply(params, batch, ahead=True, method="of_all")

    @jax.jit  # of the largest of equal cells, which is taken is a matter of rounding
    def compared(params):
        def gradient(tokens):
            return jax.grad(lambda params: (weights * jnp.tanh(tokens(params))).sum())(params)

        seen = alone, together
        return [gradient(each) if differentiated else each(params) for each in seen]

    expected, found = compared(params)
    assert_same(found, expected)
    if not differentiated:
        assert found.shape == weights.shape


def assert_same(found, expected):
    """But for rounding, array by array."""

    def same(one, other):
        largest = np.abs(other).max()
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4 * largest)
        return largest

    assert max(jax.tree.leaves(jax.tree.map(same, found, expected))) > 1e-3


class Walk(nn.Module):
    """A token for each state of a walk; who walks against a wall stays where he is."""

    width: int

    def setup(self):
        self.read = nn.Dense(self.width)

    def __call__(self, context):
        return jnp.tanh(self.read(jnp.concatenate([context.past, context.observation[None]])))

    def of_all(self, contexts):
        states = jnp.concatenate([contexts.past, contexts.observation[:, None]], axis=1)
        first, total, which = once.runs(states)
        each = states.reshape(-1, 3)[first]
        tokens = once.of_first(lambda _, state: jnp.tanh(self.read(state)), each, each, total, 4)
        return tokens[which]


WALKS = mixed.DOMAIN._replace(encoders={"paper": lambda model, context: Walk(model.width)})
METHODS = [
    pytest.param(name, marks=() if name == "leap" else only_long)
    for name in ("bc", "dt", "bcq", "iql", "mopo", "plate", "qr_dqn", "leap")
]


@only_long
@pytest.mark.parametrize("name", METHODS)
def test_methods_learn_the_same_from_what_is_seen_at_once(name, monkeypatch):
    """The loss and the gradient of a step are those without, the encoder's included."""
    method, key = find_method(name), jax.random.key(0)
    horizon = 3 if name in ("leap", "plate") else 1
    model = ModelConfig("paper", layers=1, heads=2, width=16, dropout=0.1)
    parts = TrainingConfig(batch=6, microbatch=2)
    setup, looked = Setup(WALKS, 2, horizon, model, parts, method.settings()), []
    of_all = Walk.of_all
    monkeypatch.setattr(Walk, "of_all", lambda *given: looked.append(1) or of_all(*given))

    def step():
        agent = method.make_agent(setup, None)
        state = random_state(agent)
        batch = quick_jit(agent.batch)(key, mixed.steps(episodes=1))
        state, metrics = quick_jit(agent.update)(state, batch, key)
        return jax.device_get((optax.tree.get(state.optimizer, "mu"), metrics))

    found = step()
    assert looked
    monkeypatch.setattr(Setup, "seen_at_once", lambda *_: learning.nothing_prepared)
    looked.clear()
    expected = step()
    assert not looked
    assert_same(found, expected)
    leaves = jax.tree.leaves_with_path(expected[0])
    encoder = [leaf for path, leaf in leaves if "read" in str(path)]
    assert encoder and all(np.abs(leaf).max() > 1e-7 for leaf in encoder)
