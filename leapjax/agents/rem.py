"""Random ensemble mixture (Agarwal et al., 2020).

One network has many Q-functions. Each training step minimises the Bellman error of a random mixture
of them. The agent chooses the action with the highest mean.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax.agents import losses, q_learning
from leapjax.agents.base import Method, Setup
from leapjax.agents.q_learning import MakeTargets, TransitionOutputs
from leapjax.agents.rewards import ValueSettings
from leapjax.checks import check_at_least
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings(ValueSettings):
    """The options of REM. The defaults are the original's, except the target network's.

    Attributes:
        q_heads: Number of Q-functions.
    """

    q_heads: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, 1, "q_heads", most=10_000)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a REM agent; its energy is minus the mean of the Q-functions."""
    count, choices = setup.settings.q_heads, setup.domain.num_actions - 1  # all but the end

    def mix(outputs: jax.Array, weights: jax.Array) -> jax.Array:
        return outputs.reshape(-1, choices, count) @ weights  # [P, A - 1]

    def loss(steps: TransitionOutputs, make_targets: MakeTargets, key: jax.Array) -> jax.Array:
        """Returns the losses `[P]` of a mixture that gives both the estimates and the targets."""
        # Each example draws its own mixture; the original draws a single mixture for a batch. The
        # expected loss is equal, and its variance is smaller.
        weights = draw_mixture(key, count)
        targets = make_targets(mix(steps.target_after, weights).max(axis=1))
        estimates = losses.select_values(mix(steps.before, weights), steps.actions)
        return optax.losses.huber_loss(estimates, targets)

    def read_values(outputs: jax.Array) -> jax.Array:
        return mix(outputs, jnp.full(count, 1 / count))

    return q_learning.make_agent(setup, mesh, choices * count, loss, read_values)


def draw_mixture(key: jax.Array, count: int) -> jax.Array:
    """Draws weights `[count]` that sum to 1: uniform numbers, divided by their sum."""
    drawn = 1 - jax.random.uniform(key, (count,))  # in (0, 1]: they never sum to 0
    return drawn / drawn.sum()


REM = Method(Settings, make_agent, rewards=True)
