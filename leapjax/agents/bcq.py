"""Batch-constrained Q-learning for discrete actions (Fujimoto et al., 2019).

It learns a Q-function and a model of the data's behaviour. The Bellman targets take the best of the
actions that are likely in the data, because the Q-values of other actions are unknown. The agent
acts by the same rule.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax.agents import losses
from leapjax.agents.acting import make_acting_energy, make_encode_next
from leapjax.agents.base import Method, Setup
from leapjax.agents.batch_loss import average_loss
from leapjax.agents.batches import transition_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.q_learning import apply_to_transition, make_transition_encoder
from leapjax.agents.rewards import ValueSettings
from leapjax.agents.update import apply_to_context, follow_parameters, make_init, make_update
from leapjax.checks import LARGEST, check_within
from leapjax.models.policy import Outputs
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


@dataclasses.dataclass(frozen=True)
class Settings(ValueSettings):
    """The options of BCQ alone. The defaults are the original's, except the target network's.

    Attributes:
        threshold: Smallest probability of an allowed action, as a share of the likeliest action's.
        logit_penalty: Weight of the squares of the behaviour model's logits in the loss.
    """

    threshold: float = 0.3
    logit_penalty: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        check_within(self, 0, 1, "threshold")
        check_within(self, 0, LARGEST, "logit_penalty")


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a BCQ agent; its energy is minus the Q-values of likely actions, +inf for others."""
    settings, choices = setup.settings, setup.domain.num_actions - 1  # all but the end
    module = setup.make_policy(("q", choices), ("behaviour", choices))
    optimizer = make_optimizer(setup.training)

    def apply(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, tokens=tokens)

    def score(outputs: Outputs) -> jax.Array:
        return mask_unlikely_values(outputs, settings.threshold)

    def transition_loss(
        params: Params,
        target: PyTree,
        transition: TransitionWindow,
        tokens: PyTree,
        key: jax.Array,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Sums the losses of the temporal difference and of the behaviour model."""
        context = transition.context
        before, after, target_after = apply_to_transition(
            module, params, target, context, tokens, key
        )
        # Double Q-learning: the network chooses, the target network evaluates.
        best = jnp.argmax(score(after), axis=1)
        values = losses.select_values(target_after["q"], best)  # [P]
        taken, known = losses.find_transition_actions(context, len(values), choices)
        targets = losses.bellman_targets(transition, values, settings.discount)
        estimates = losses.select_values(before["q"], taken)
        errors = optax.losses.huber_loss(estimates, targets)
        cloning, accuracy = losses.imitation_loss(before["behaviour"], taken, known)
        squares = (before["behaviour"] ** 2).mean(axis=1)
        loss = losses.average_where(errors + settings.logit_penalty * squares, known) + cloning
        return loss, {"accuracy": accuracy, "value": losses.average_where(estimates, known)}

    init = make_init(setup, module, apply_to_context, optimizer, target=lambda params: params)
    mean_loss = average_loss(setup, transition_loss, make_transition_encoder(module))
    update = make_update(mean_loss, optimizer, mesh, follow_parameters(settings.target_rate))
    energy = make_acting_energy(setup, apply, score)
    encode_next = make_encode_next(setup, module, apply)
    return Agent(init, transition_batches(setup), update, energy, encode_next)


def mask_unlikely_values(outputs: Outputs, threshold: float) -> jax.Array:
    """Sets the Q-values `[P, A - 1]` of unlikely actions to -inf.

    Args:
        outputs: Q-values and behaviour logits, `[P, A - 1]` each.
        threshold: smallest probability, as a share of the likeliest action's.
    """
    likelihoods = jax.nn.softmax(outputs["behaviour"])
    likely = likelihoods >= threshold * likelihoods.max(axis=1, keepdims=True)
    return jnp.where(likely, outputs["q"], -jnp.inf)


BCQ = Method(Settings, make_agent, rewards=True)
