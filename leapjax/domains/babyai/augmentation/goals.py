"""Hides the goal, so that a network learns to find it from the instruction."""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai.observations import NO_GOAL, Observation
from leapjax.types import Window


def hide_goal(key: jax.Array, window: Window, share: float) -> Window:
    """Hides the goal in all states of a window, with a probability.

    Args:
        key: random key.
        window: training window.
        share: probability that the goal is hidden.
    """
    hidden = jax.random.bernoulli(key, share)

    def hide(observation: Observation) -> Observation:
        goal = jnp.asarray(observation.goal)
        nowhere = jnp.array(NO_GOAL, goal.dtype)
        blank = (jnp.asarray(observation.grid) == 0).all(axis=(-3, -2, -1))  # before the start
        return observation._replace(goal=jnp.where(hidden & ~blank[..., None], nowhere, goal))

    context = window.context
    changed = context._replace(observation=hide(context.observation), past=hide(context.past))
    return window._replace(context=changed)
