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


class States(Encoder):
    """A token for each state of a context."""

    @nn.compact
    def __call__(self, context):
        states = jnp.concatenate([context.past, context.observation[None]])
        return nn.Dense(16)(states)


def make_context(past):
    rng = np.random.default_rng(3)
    states, actions = rng.normal(size=(past + 1, 2)), rng.integers(0, ACTIONS - 1, past)
    return Context(states[-1], states[:-1], actions, np.zeros(past), np.int32(5), np.float32(0))


@functools.cache
def model(architecture, past=PAST):
    """What a network says of a context; its parameters are all random."""
    config = ModelConfig(architecture, layers=2, heads=2, width=16)
    heads = (("logits", ACTIONS - 1), ("value", 1))
    module = PolicyModel(config, Sizes(ACTIONS, past, 1, 20), States(), heads)
    shapes = jax.eval_shape(module.init, jax.random.key(0), make_context(past))
    return functools.partial(quick_jit(module.apply), random_like(shapes, scale=1.0))


@pytest.mark.parametrize(
    ("architecture", "past", "states"),
    [("paper", PAST, PAST + 1), ("paper", 0, 1), ("leapjax", PAST, 1)],
)
def test_each_head_speaks_of_each_state(architecture, past, states):
    said = model(architecture, past)(make_context(past))
    shapes = {name: values.shape for name, values in said.items()}
    assert shapes == {"logits": (states, ACTIONS - 1), "value": (states, 1)}
    assert all(np.isfinite(values).all() for values in said.values())


def test_what_is_said_of_a_state_depends_on_what_came_before_it_alone():
    given, say = make_context(PAST), model("paper")
    now = np.arange(PAST)
    before = say(given)["logits"]
    # In the order of the tokens: s_0 a_0 s_1 a_1 s_2 a_2 s_3.
    changed = []
    for place in range(PAST):
        other = given.past + (now == place)[:, None]
        changed.append((place, given._replace(past=other)))
        # An action is seen from the next state on, PAD as a token of its own.
        for action in ((given.actions[place] + 1) % (ACTIONS - 1), pad_token(ACTIONS)):
            other = np.where(now == place, action, given.actions)
            changed.append((place + 1, given._replace(actions=other)))
    changed.append((PAST, given._replace(observation=given.observation + 1)))
    for first, other in changed:
        differs = np.abs(say(other)["logits"] - before).max(axis=1) > 1e-5
        assert differs.tolist() == [state >= first for state in range(PAST + 1)], first
