"""The network of methods that choose one action at a time."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.policy import PolicyModel
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


def test_what_is_said_of_a_state_depends_on_what_came_before_it_alone():
    config = ModelConfig("paper", layers=2, heads=2, width=16)
    module = PolicyModel(config, Sizes(ACTIONS, PAST, 1, 20), States(), (("logits", ACTIONS - 1),))
    rng = np.random.default_rng(3)
    given = Context(
        rng.normal(size=2), rng.normal(size=(PAST, 2)), rng.integers(0, ACTIONS - 1, PAST),
        np.zeros(PAST), np.int32(5), np.float32(0),
    )  # fmt: skip
    params = random_like(jax.eval_shape(module.init, jax.random.key(0), given), scale=1.0)
    say = functools.partial(quick_jit(module.apply), params)
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
