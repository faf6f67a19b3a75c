"""Random ensemble mixture (Agarwal et al., 2020).

Many Q-functions on one network, of which ever other mixtures must satisfy the Bellman equation; it
acts by their mean.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax.agents import losses, q_learning
from leapjax.agents.base import Method, Setup
from leapjax.agents.q_learning import Judged, Returns
from leapjax.checks import check_at_least
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings(q_learning.Settings):
    """The options of REM. The defaults are the original's, but for the target network.

    Attributes:
        q_heads: Q-functions that are mixed at random.
    """

    q_heads: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, 1, "q_heads", most=10_000)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """REM as an `Agent`; its energy is minus the mean of the Q-functions."""
    count, choices = setup.settings.q_heads, setup.domain.num_actions - 1  # the end is not chosen

    def mixed(said: jax.Array, weights: jax.Array) -> jax.Array:
        return said.reshape(-1, choices, count) @ weights  # [P, A - 1]

    def loss(judged: Judged, returns: Returns, key: jax.Array) -> jax.Array:
        """The same mixture on both sides of the Bellman equation."""
        # One for each example: the original draws one for all of a batch. What is expected of
        # the loss is the same, and it varies less.
        weights = mixture(key, count)
        targets = returns(mixed(judged.held, weights).max(axis=1))
        estimates = losses.of_action(mixed(judged.now, weights), judged.taken)
        return optax.losses.huber_loss(estimates, targets)

    def values(said: jax.Array) -> jax.Array:
        return mixed(said, jnp.full(count, 1 / count))

    return q_learning.make_agent(setup, mesh, choices * count, loss, values)


def mixture(key: jax.Array, count: int) -> jax.Array:
    """`[count]` weights that sum to 1: uniform numbers, divided by their sum."""
    drawn = 1 - jax.random.uniform(key, (count,))  # in (0, 1]: they never sum to 0
    return drawn / drawn.sum()


REM = Method(Settings, make_agent, rewards=True)
