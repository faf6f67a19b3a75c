"""Walks of good and bad policies in the toy world; its optimal actions and values."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from leapjax.data import windows
from leapjax.domain import Augmentations
from leapjax.models.encoder import Encoder
from leapjax.types import Demonstration
from tests import toy
from tests.toy import FARTHEST, LEFT, RIGHT

PLACES = np.array([x for x in range(-FARTHEST, FARTHEST + 1) if x])


class Place(Encoder):
    """Embeds the place by a table, so that the value of each place is learned separately."""

    width: int

    @nn.compact
    def __call__(self, context):
        place = context.observation[0].astype(jnp.int32) + FARTHEST
        return nn.Embed(2 * FARTHEST + 1, self.width)(place)[None]


class Places(Encoder):
    """Embeds the place of each state in a context, as the paper's encoder does."""

    width: int

    @nn.compact
    def __call__(self, context):
        states = jnp.concatenate([context.past, context.observation[None]])
        places = states[:, 0].astype(jnp.int32) + FARTHEST
        return nn.Embed(2 * FARTHEST + 1, self.width)(places)


DOMAIN = toy.DOMAIN._replace(
    encoders={
        "leapjax": lambda model, sizes: Place(model.width),
        "paper": lambda model, sizes: Places(model.width),
    },
    augmentations=Augmentations(),
)


def towards(place):
    return LEFT if place > 0 else RIGHT


def walk(rng, start, share, limit=30):
    """Makes a walk that steps towards the middle with probability `share`, else away from it."""
    places, actions = [start], []
    while places[-1] and len(actions) < limit:
        place = places[-1]
        good = rng.random() < share
        actions.append(towards(place) if good else towards(-place))
        places.append(int(np.clip(place + (1 if actions[-1] == RIGHT else -1), -5, 5)))
    over = places[-1] == 0
    rewards = np.zeros(len(actions), np.float32)
    rewards[-1] = over
    states = np.stack([toy.observe(place) for place in places])
    return Demonstration(states, np.array(actions, np.int32), rewards, over, not over, start)


def steps(share=0.4, episodes=20):
    """Joins walks that step away from the middle more often than towards it."""
    rng = np.random.default_rng(0)
    walks = [walk(rng, int(start), share) for start in PLACES for _ in range(episodes)]
    return jax.tree.map(jnp.asarray, windows.concatenate(walks))


def contexts(past):
    """Makes a context for each place but the middle, at the start of an episode."""
    blank = windows.window(steps(episodes=1), 0, past, 1, toy.END).context
    states = np.stack([toy.observe(place) for place in PLACES])
    blanks = jax.tree.map(lambda leaf: np.stack([leaf] * len(PLACES)), blank)
    return blanks._replace(observation=states)


def best_actions():
    return np.array([towards(place) for place in PLACES])


def best_values(discount):
    """Computes Q of steps towards the middle and away from it, `[10, 2]`, by value iteration."""
    values = np.zeros(2 * FARTHEST + 1)

    def q(place, step):
        reached = int(np.clip(place + step, -FARTHEST, FARTHEST))
        return float(reached == 0) + discount * (reached != 0) * values[reached + FARTHEST]

    for _ in range(100):
        for place in PLACES:
            values[place + FARTHEST] = max(q(place, -1), q(place, 1))
    return np.array([[q(p, -np.sign(p)), q(p, np.sign(p))] for p in PLACES])
