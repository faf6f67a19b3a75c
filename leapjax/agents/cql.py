"""Conservative Q-learning for discrete actions (Kumar et al., 2020).

Q-learning that also lowers the Q-values of all actions and raises those of what was done, so that
no action looks good merely because the data do not hold it.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax.agents import losses, q_learning
from leapjax.agents.base import Method, Setup
from leapjax.agents.q_learning import Judged, Returns
from leapjax.checks import LARGEST, check_within
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings(q_learning.Settings):
    """The options of CQL. The defaults are the original's, but for the target network.

    In the authors' code, and in d3rlpy, Q-values are means of 200 quantiles, whose losses are
    summed. An `alpha` of 4 weighs against those what 0.04 weighs here, against one loss.

    Attributes:
        alpha: Weight of the conservative term; 0 leaves double Q-learning.
    """

    alpha: float = 0.04

    def __post_init__(self) -> None:
        super().__post_init__()
        check_within(self, 0, LARGEST, "alpha")


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """CQL as an `Agent`; its energy is minus the Q-values."""

    def loss(judged: Judged, returns: Returns, key: jax.Array) -> jax.Array:
        """Equation 4."""
        del key
        # Chosen by the one network and valued by the other, as in double Q-learning.
        best = jnp.argmax(judged.later, axis=1)
        targets = returns(losses.of_action(judged.held, best))
        estimates = losses.of_action(judged.now, judged.taken)
        errors = optax.losses.huber_loss(estimates, targets)
        return errors + setup.settings.alpha * conservative(judged.now, judged.taken)

    return q_learning.make_agent(setup, mesh, setup.domain.num_actions - 1, loss, lambda q: q)


def conservative(q: jax.Array, taken: jax.Array) -> jax.Array:
    """By how much the best of Q-values `[P, A - 1]`, softly, exceeds that of actions `[P]`."""
    return jax.nn.logsumexp(q, axis=1) - losses.of_action(q, taken)


CQL = Method(Settings, make_agent, rewards=True)
