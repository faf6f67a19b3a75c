"""Decision Transformer (Chen et al., 2021): the action that leads to a return.

Trained like behaviour cloning, but on what the demonstration gave from each state on. It acts
by asking for a target return, less what the episode has given so far.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents.imitation import make_imitator
from leapjax.agents.learning import SINGLE_ACTION_PRESETS, Method, Setup
from leapjax.types import Agent, Context


@dataclasses.dataclass(frozen=True)
class Settings:
    """The options of Decision Transformer alone."""

    target_return: float = 1.0  # of an episode, asked for while acting

    def __post_init__(self) -> None:
        if not abs(self.target_return) < float("inf"):  # false for NaN too
            raise ValueError(f"target_return must be a number, got {self.target_return}")


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Decision Transformer as an `Agent`."""

    def returns(context: Context, return_to_go: jax.Array | None) -> jax.Array:
        if return_to_go is None:
            return_to_go = setup.settings.target_return - context.return_so_far
        return returns_to_go(context, return_to_go)

    return make_imitator(setup, mesh, returns)


def returns_to_go(context: Context, now: jax.Array) -> jax.Array:
    """`[K + 1]`: what was to come at the past states and the current one, given `now []`."""
    later = jnp.cumsum(context.rewards[::-1])[::-1]
    return now + jnp.append(later, 0.0)


DT = Method(Settings, make_agent, SINGLE_ACTION_PRESETS, rewards=True)
