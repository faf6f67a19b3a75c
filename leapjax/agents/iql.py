"""Implicit Q-learning for discrete actions (Kostrikov et al., 2022).

The value of a state is a high expectile of the Q-values of the data's actions, so learning never
evaluates other actions. The policy is behaviour cloning, weighted by the advantages of the actions.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents import losses
from leapjax.agents.acting import make_acting_energy, make_encode_next
from leapjax.agents.base import Method, Setup
from leapjax.agents.batch_loss import average_loss
from leapjax.agents.batches import transition_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.rewards import ValueSettings
from leapjax.agents.update import apply_to_context, follow_parameters, make_init, make_update
from leapjax.checks import LARGEST, check_within
from leapjax.data import windows
from leapjax.models.policy import Outputs, PolicyModel
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


@dataclasses.dataclass(frozen=True)
class Settings(ValueSettings):
    """The options of IQL alone.

    The IQL paper uses this expectile for ant mazes, and this inverse temperature for locomotion.
    LEAP's paper gives neither value.

    Attributes:
        expectile: Expectile of the Q-values that the value network learns.
        inverse_temperature: Factor of the advantages in the exponential weights of the cloned
            actions.
        largest_weight: Upper bound of those weights.
    """

    expectile: float = 0.9
    inverse_temperature: float = 3.0
    largest_weight: float = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_within(self, 0, 1, "expectile")
        check_within(self, 0, LARGEST, "inverse_temperature", "largest_weight")


class Networks(nn.Module):
    """A policy and its critic: two networks without shared parameters.

    Attributes:
        policy: network with the head "logits".
        critic: network with the heads "value", "q1" and "q2".
    """

    policy: PolicyModel
    critic: PolicyModel

    def __call__(self, context: Context) -> tuple[Outputs, Outputs]:
        """Applies both networks to a context."""
        return self.policy(context), self.critic(context)

    def act(
        self, context: Context, tokens: jax.Array | None = None, deterministic: bool = True
    ) -> Outputs:
        """Applies the policy to a context.

        Args:
            context: context to act from.
            tokens: encoder's tokens; if `None`, the policy encodes the context.
            deterministic: whether to leave out dropout.
        """
        return self.policy(context, deterministic, tokens=tokens)

    def judge(
        self, context: Context, tokens: tuple[jax.Array, jax.Array], deterministic: bool = True
    ) -> tuple[Outputs, Outputs]:
        """Applies the critic before and after the step of a transition."""
        return self.critic.apply_transition(context, tokens, deterministic)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the policy's tokens of a context, given the tokens of its past states."""
        return self.policy.encode_next(context, known)

    def encode_transitions(
        self, contexts: Context
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Returns the policy's tokens before steps, and the critic's tokens before and after."""
        earlier = jax.vmap(windows.before)(contexts)
        return self.policy.encode_batch(earlier), self.critic.encode_transitions(contexts)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes an IQL agent; its energy is minus the policy's logits."""
    settings, choices = setup.settings, setup.domain.num_actions - 1  # all but the end
    critic = setup.make_policy(("value", 1), ("q1", choices), ("q2", choices))
    module = Networks(setup.make_policy(("logits", choices)), critic)
    optimizer = make_optimizer(setup.training)

    def apply(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, tokens, method="act")

    def encode(params: Params, target: Params, batch: TransitionWindow) -> PyTree:
        """Encodes transitions with both networks, and the states before with the target critic."""
        earlier = jax.vmap(windows.before)(batch.context)
        return (
            module.apply(params, batch.context, method="encode_transitions"),
            critic.apply(target, earlier, method="encode_batch"),
        )

    def transition_loss(
        params: Params,
        target: PyTree,
        transition: TransitionWindow,
        tokens: PyTree,
        key: jax.Array,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the losses of value (equation 5), Q-functions (6) and policy (7)."""
        context = transition.context
        earlier = windows.before(context)
        (policy_tokens, critic_tokens), target_tokens = tokens
        options: Any = {"deterministic": False, "rngs": {"dropout": key}}
        policy: Any = module.apply(params, earlier, policy_tokens, method="act", **options)
        critics: Any = module.apply(params, context, critic_tokens, method="judge", **options)
        target_outputs: Any = critic.apply(target, earlier, tokens=target_tokens)
        now, after = critics
        taken, known = losses.find_transition_actions(
            context, len(target_outputs["value"]), choices
        )
        least = jnp.minimum(
            *(losses.select_values(target_outputs[name], taken) for name in ("q1", "q2"))
        )

        value, logits = now["value"][:, 0], policy["logits"]
        returns = losses.bellman_targets(transition, after["value"][:, 0], settings.discount)
        each = compute_losses(
            settings, value, (now["q1"], now["q2"]), least, logits, taken, returns
        )

        hits = jnp.argmax(logits, axis=1) == taken
        return losses.average_where(each, known), {
            "accuracy": losses.average_where(hits, known),
            "value": losses.average_where(value, known),
            "advantage": losses.average_where(least - value, known),
        }

    init = make_init(setup, module, apply_to_context, optimizer, target=_select_critic)
    mean_loss = average_loss(setup, transition_loss, encode)
    update = make_update(
        mean_loss, optimizer, mesh, follow_parameters(settings.target_rate, _select_critic)
    )
    energy = make_acting_energy(setup, apply)
    encode_next = make_encode_next(setup, module, apply)
    return Agent(init, transition_batches(setup), update, energy, encode_next)


def compute_losses(
    settings: Settings,
    value: jax.Array,
    qs: Sequence[jax.Array],
    least: jax.Array,
    logits: jax.Array,
    taken: jax.Array,
    returns: jax.Array,
) -> jax.Array:
    """Sums the losses `[P]` of value (equation 5), all Q-functions (6) and policy (7).

    Args:
        settings: expectile, and weights of advantages.
        value: values `[P]` of the states.
        qs: Q-values `[P, A - 1]` of each Q-function.
        least: smallest Q-values `[P]` of the actions over the target network's Q-functions.
        logits: logits `[P, A - 1]` of the policy.
        taken: actions `[P]`.
        returns: Bellman targets `[P]` of the actions.
    """
    advantages = jax.lax.stop_gradient(least) - value
    values = losses.expectile_loss(advantages, settings.expectile)
    differences = sum(jnp.square(losses.select_values(q, taken) - returns) for q in qs)
    weights = jnp.exp(settings.inverse_temperature * jax.lax.stop_gradient(advantages))
    likelihoods = losses.select_values(jax.nn.log_softmax(logits), taken)
    return values + differences - jnp.minimum(weights, settings.largest_weight) * likelihoods


def _select_critic(params: Params) -> Params:
    """Selects the critic's parameters."""
    return {"params": params["params"]["critic"]}


IQL = Method(Settings, make_agent, rewards=True)
