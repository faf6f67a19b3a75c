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
    """Encodes each state of a context as a token."""

    @nn.compact
    def __call__(self, context):
        states = jnp.concatenate([context.past, context.observation[None]])
        return nn.Dense(16)(states)


def test_outputs_depend_only_on_the_state_and_its_past():
    config = ModelConfig("paper", layers=2, heads=2, width=16)
    module = PolicyModel(config, Sizes(ACTIONS, PAST, 1, 20), States(), (("logits", ACTIONS - 1),))
    rng = np.random.default_rng(3)
    original = Context(
        rng.normal(size=2), rng.normal(size=(PAST, 2)), rng.integers(0, ACTIONS - 1, PAST),
        np.zeros(PAST), np.int32(5), np.float32(0),
    )  # fmt: skip
    params = random_like(jax.eval_shape(module.init, jax.random.key(0), original), scale=1.0)
    compute_outputs = functools.partial(quick_jit(module.apply), params)
    places = np.arange(PAST)
    before = compute_outputs(original)["logits"]
    # The order of the tokens is s_0 a_0 s_1 a_1 s_2 a_2 s_3.
    changed = []
    for place in range(PAST):
        other = original.past + (places == place)[:, None]
        changed.append((place, original._replace(past=other)))
        # An action affects states from the next one on; PAD has its own token.
        for action in ((original.actions[place] + 1) % (ACTIONS - 1), pad_token(ACTIONS)):
            other = np.where(places == place, action, original.actions)
            changed.append((place + 1, original._replace(actions=other)))
    changed.append((PAST, original._replace(observation=original.observation + 1)))
    for first, other in changed:
        differs = np.abs(compute_outputs(other)["logits"] - before).max(axis=1) > 1e-5
        assert differs.tolist() == [state >= first for state in range(PAST + 1)], first
