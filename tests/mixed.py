"""Data of many policies in the toy world, good and bad, and what is best in it."""

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
    """A token for each place: a table, so that values are learned one by one."""

    width: int

    @nn.compact
    def __call__(self, context):
        place = context.observation[0].astype(jnp.int32) + FARTHEST
        return nn.Embed(2 * FARTHEST + 1, self.width)(place)[None]


class Places(Encoder):
    """The same for each state of a context, as the paper's encoder has it."""

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
    """One that steps towards the middle with that probability, and away from it else."""
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
    """Walks that go wrong more often than right."""
    rng = np.random.default_rng(0)
    walks = [walk(rng, int(start), share) for start in PLACES for _ in range(episodes)]
    return jax.tree.map(jnp.asarray, windows.concatenate(walks))


def contexts(past):
    """Each place but the middle, as an episode begins there."""
    blank = windows.window(steps(episodes=1), 0, past, 1, toy.END).context
    states = np.stack([toy.observe(place) for place in PLACES])
    many = jax.tree.map(lambda leaf: np.stack([leaf] * len(PLACES)), blank)
    return many._replace(observation=states)


def best_actions():
    return np.array([towards(place) for place in PLACES])


def best_values(discount):
    """Q of a step towards the middle and of one away from it, by value iteration: `[10, 2]`."""
    values = np.zeros(2 * FARTHEST + 1)

    def q(place, step):
        then = int(np.clip(place + step, -FARTHEST, FARTHEST))
        return float(then == 0) + discount * (then != 0) * values[then + FARTHEST]

    for _ in range(100):
        for place in PLACES:
            values[place + FARTHEST] = max(q(place, -1), q(place, 1))
    return np.array([[q(p, -np.sign(p)), q(p, np.sign(p))] for p in PLACES])
