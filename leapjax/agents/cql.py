"""Conservative Q-learning for discrete actions (Kumar et al., 2020).

Q-learning that also lowers the Q-values of all actions, and raises the Q-values of the actions in
the data. So no action looks good only because it is missing from the data.
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
from leapjax.checks import LARGEST, check_within
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings(ValueSettings):
    """The options of CQL. The defaults are the original's, except the target network's.

    In the authors' code and in d3rlpy, a Q-value is the mean of 200 quantiles, and their losses are
    summed. Here a Q-value has a single loss, so an `alpha` of 4 there equals 0.04 here.

    Attributes:
        alpha: Weight of the conservative term; 0 gives double Q-learning.
    """

    alpha: float = 0.04

    def __post_init__(self) -> None:
        super().__post_init__()
        check_within(self, 0, LARGEST, "alpha")


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a CQL agent; its energy is minus the Q-values."""

    def loss(steps: TransitionOutputs, make_targets: MakeTargets, key: jax.Array) -> jax.Array:
        """Returns the losses `[P]` (Kumar et al., equation 4)."""
        del key
        # Double Q-learning: the network chooses, the target network evaluates.
        best = jnp.argmax(steps.after, axis=1)
        targets = make_targets(losses.select_values(steps.target_after, best))
        estimates = losses.select_values(steps.before, steps.actions)
        errors = optax.losses.huber_loss(estimates, targets)
        return errors + setup.settings.alpha * conservative_penalty(steps.before, steps.actions)

    return q_learning.make_agent(setup, mesh, setup.domain.num_actions - 1, loss, lambda q: q)


def conservative_penalty(q: jax.Array, actions: jax.Array) -> jax.Array:
    """Returns `[P]`: the soft maximum of Q-values `[P, A - 1]` minus the value of actions `[P]`."""
    return jax.nn.logsumexp(q, axis=1) - losses.select_values(q, actions)


CQL = Method(Settings, make_agent, rewards=True)
