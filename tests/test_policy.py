"""The network of methods that choose one action at a time."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.models.encoder import Encoder
from leapjax.models.policy import PolicyModel
from leapjax.models.trajectory import ModelConfig, Sizes
from leapjax.types import Context, pad_token
from tests.parameters import random_like
from tests.quick import quick_jit

PAST, ACTIONS = 3, 4
HEADS = (("logits", ACTIONS - 1), ("value", 1))


class States(Encoder):
    """A token for each state of a context."""

    @nn.compact
    def __call__(self, context):
        states = jnp.concatenate([context.past, context.observation[None]])
        return nn.Dense(16)(states)


def context(seed, past=PAST):
    rng = np.random.default_rng(seed)
    return Context(
        observation=rng.normal(size=2).astype(np.float32),
        past=rng.normal(size=(past, 2)).astype(np.float32),
        actions=rng.integers(0, ACTIONS - 1, past).astype(np.int32),
        rewards=np.zeros(past, np.float32), step=np.int32(5), return_so_far=np.float32(0),
    )  # fmt: skip


def changed(array, place, value):
    """A copy that differs in one place."""
    copy = array.copy()
    copy[place] = value
    return copy


@functools.cache
def model(architecture, past=PAST):
    """A network and its parameters, every one of them random."""
    config = ModelConfig(architecture, layers=2, heads=2, width=16)
    module = PolicyModel(config, Sizes(ACTIONS, past, 1, 20), States(), HEADS)
    shapes = jax.eval_shape(module.init, jax.random.key(0), context(1, past))
    return quick_jit(module.apply), random_like(shapes, scale=1.0)


@pytest.mark.parametrize(
    ("architecture", "past", "states"),
    [("paper", PAST, PAST + 1), ("paper", 0, 1), ("leapjax", PAST, 1)],
)
def test_each_head_speaks_of_each_state(architecture, past, states):
    apply, params = model(architecture, past)
    said = apply(params, context(3, past))
    shapes = {name: values.shape for name, values in said.items()}
    assert shapes == {"logits": (states, ACTIONS - 1), "value": (states, 1)}
    assert all(np.isfinite(values).all() for values in said.values())


def test_what_is_said_of_a_state_depends_on_what_came_before_it_alone():
    apply, params = model("paper")
    given = context(3)
    before = apply(params, given)["logits"]
    # In the order of the tokens: s_0 a_0 s_1 a_1 s_2 a_2 s_3.
    for place in range(2 * PAST + 1):
        state, is_action = divmod(place, 2)
        if is_action:
            action = (given.actions[state] + 1) % (ACTIONS - 1)
            other = given._replace(actions=changed(given.actions, state, action))
        elif state < PAST:
            other = given._replace(past=changed(given.past, state, given.past[state] + 1))
        else:
            other = given._replace(observation=given.observation + 1)
        differs = np.abs(apply(params, other)["logits"] - before).max(axis=1) > 1e-5
        first = state + is_action  # an action is seen from the next state on
        assert differs.tolist() == [s >= first for s in range(PAST + 1)], place


def test_padded_actions_are_tokens_of_their_own():
    apply, params = model("paper")
    given = context(3)
    padded = given._replace(actions=changed(given.actions, 0, pad_token(ACTIONS)))
    assert not np.allclose(apply(params, padded)["logits"][-1], apply(params, given)["logits"][-1])
