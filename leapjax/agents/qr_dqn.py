"""Distributional Q-learning by quantile regression (Dabney et al., 2018).

It learns quantiles of the return of each action, and chooses the action with the highest mean.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents import losses, q_learning
from leapjax.agents.base import Method, Setup
from leapjax.agents.q_learning import MakeTargets, TransitionOutputs
from leapjax.agents.rewards import ValueSettings
from leapjax.checks import check_at_least
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings(ValueSettings):
    """The options of QR-DQN. The defaults are the original's, except the target network's.

    Attributes:
        quantiles: Number of quantiles of each action's return.
    """

    quantiles: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        # The loss compares all pairs of quantiles.
        check_at_least(self, 1, "quantiles", most=1000)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a QR-DQN agent; its energy is minus the means of the quantiles."""
    count, choices = setup.settings.quantiles, setup.domain.num_actions - 1  # all but the end

    def read_quantiles(outputs: jax.Array) -> jax.Array:
        return outputs.reshape(-1, choices, count)

    def read_values(outputs: jax.Array) -> jax.Array:
        return read_quantiles(outputs).mean(axis=2)

    def loss(steps: TransitionOutputs, make_targets: MakeTargets, key: jax.Array) -> jax.Array:
        """Returns the losses `[P]` (Dabney et al., algorithm 1)."""
        del key
        best = jnp.argmax(read_values(steps.target_after), axis=1)
        targets = make_targets(
            losses.select_values(read_quantiles(steps.target_after), best)
        )  # [P, N]
        estimates = losses.select_values(read_quantiles(steps.before), steps.actions)
        return losses.quantile_huber_loss(estimates, targets)

    return q_learning.make_agent(setup, mesh, choices * count, loss, read_values)


QR_DQN = Method(Settings, make_agent, rewards=True)
