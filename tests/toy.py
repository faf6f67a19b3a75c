"""A toy world whose networks compile in seconds: walk along a line to its middle."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from leapjax import training
from leapjax.data import windows
from leapjax.domain import Augmentations, Domain
from leapjax.fitting import make_domain
from leapjax.models.encoder import Encoder
from leapjax.types import Demonstration
from tests.quick import quick_jit

LEFT, RIGHT, WAIT, END = range(4)
FARTHEST = 5


class Token(Encoder):
    """The current state as the only token of a context."""

    width: int

    @nn.compact
    def __call__(self, context):
        return nn.Dense(self.width)(context.observation)[None]


def observe(place):
    return np.array([place, abs(place), 1], np.float32)


def mirror(key, window):
    """Mirrors a window with probability 1/2."""
    flipped = jax.random.bernoulli(key)

    def mirror_actions(actions):
        swapped = jnp.array([RIGHT, LEFT, WAIT, END])[jnp.minimum(actions, END)]
        return jnp.where(flipped & (actions <= END), swapped, actions)

    def mirror_states(states):
        return jnp.where(flipped, states * jnp.array([-1, 1, 1]), states)

    context = window.context._replace(
        observation=mirror_states(window.context.observation),
        past=mirror_states(window.context.past),
        actions=mirror_actions(window.context.actions),
    )
    return window._replace(context=context, actions=mirror_actions(window.actions))


def raise_not_implemented(*arguments):
    raise NotImplementedError


DOMAIN = Domain(
    level="Line",
    make_adapter=raise_not_implemented,
    actions=("left", "right", "wait", "end"),
    max_steps=FARTHEST,
    blank=np.zeros(3, np.float32),
    encoders={"leapjax": lambda model, sizes: Token(model.width)},
    augmentations=Augmentations([mirror]),
)


@functools.cache
def compile_augmentation(name, level):
    """Collects demonstrations, and compiles a function that augments their window at a step.

    Returns:
        The demonstrations, and (key, step) -> the window before and after augmentation.
    """
    domain = make_domain(name, level)
    data = domain.demonstrations.collect(4, 0, lambda done: None).demonstrations
    steps = jax.tree.map(jnp.asarray, windows.concatenate(data, domain.augmentations.extras))
    sizes = {"context": 2, "horizon": domain.max_steps, "end": domain.num_actions - 1}
    (augment,) = domain.augmentations.functions

    def cut(key, step):
        window = windows.window(steps, step, **sizes)
        return window, augment(key, window)

    return data, jax.jit(cut)


def learn(agent, data, steps):
    """Trains an agent; returns its state and the metrics on the way."""
    metrics, placed = [], jax.tree.map(jnp.asarray, data)
    state = training.train(
        training.make_train_step(agent), quick_jit(agent.init)(jax.random.key(0)),
        lambda done: placed, jax.random.key(1), steps,
        lambda done, state, means: metrics.append(means),
    )  # fmt: skip
    return state, metrics


def demonstrations():
    """Makes the shortest demonstration from every place but the middle."""
    found = []
    for start in (x for x in range(-FARTHEST, FARTHEST + 1) if x):
        places = [start]
        while places[-1]:
            places.append(places[-1] - np.sign(start))
        actions = np.full(abs(start), LEFT if start > 0 else RIGHT, np.int32)
        rewards = np.array(places[1:], np.float32) == 0
        states = np.stack([observe(place) for place in places])
        found.append(Demonstration(states, actions, rewards * np.float32(1), True, False, start))
    return found
