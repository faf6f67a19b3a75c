"""Distributional Q-learning by quantile regression (Dabney et al., 2018).

Of each action the quantiles of its return are learned; it acts by their mean.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents import losses, q_learning
from leapjax.agents.base import Method, Setup
from leapjax.agents.q_learning import Judged, Returns
from leapjax.checks import check_at_least
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings(q_learning.Settings):
    """The options of QR-DQN. The defaults are the paper's, but for the target network.

    Attributes:
        quantiles: Quantiles of the return that are learned of each action.
    """

    quantiles: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        # Its loss compares each with each.
        check_at_least(self, 1, "quantiles", most=1000)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """QR-DQN as an `Agent`; its energy is minus the means of the quantiles."""
    count, choices = setup.settings.quantiles, setup.domain.num_actions - 1  # the end is not chosen

    def quantiles(said: jax.Array) -> jax.Array:
        return said.reshape(-1, choices, count)

    def values(said: jax.Array) -> jax.Array:
        return quantiles(said).mean(axis=2)

    def loss(judged: Judged, returns: Returns, key: jax.Array) -> jax.Array:
        """Algorithm 1."""
        del key
        best = jnp.argmax(values(judged.held), axis=1)
        targets = returns(losses.of_action(quantiles(judged.held), best))  # [P, N]
        estimates = losses.of_action(quantiles(judged.now), judged.taken)
        return losses.quantile_huber(estimates, targets)

    return q_learning.make_agent(setup, mesh, choices * count, loss, values)


QR_DQN = Method(Settings, make_agent, rewards=True)
