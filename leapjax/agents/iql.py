"""Implicit Q-learning for discrete actions (Kostrikov et al., 2022).

The value of a state is a high expectile of the Q-values of what was done there, so that no action
is ever tried that the data do not hold; the policy is behaviour cloning, weighted by the advantage
of what was done.
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
from leapjax.agents.update import apply_to_context, follow_parameters, make_init, make_update
from leapjax.checks import LARGEST, check_types, check_within
from leapjax.data import windows
from leapjax.models.policy import PolicyModel, Said
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


@dataclasses.dataclass(frozen=True)
class Settings:
    """The options of IQL alone.

    The IQL paper has the expectile in its mazes of ants, the temperature in its locomotion; LEAP's
    does not say what it took.

    Attributes:
        expectile: Expectile of the Q-values that the value network learns.
        inverse_temperature: Factor of the advantages in the exponential weights of the cloned
            actions.
        largest_weight: Upper bound of those weights.
        discount: Discount of rewards per step.
        target_rate: How far the target network moves towards the network at each step, in 0 .. 1.
    """

    expectile: float = 0.9
    inverse_temperature: float = 3.0
    largest_weight: float = 100.0
    discount: float = 0.99
    target_rate: float = 0.005

    def __post_init__(self) -> None:
        check_types(self)
        check_within(self, 0, 1, "expectile", "discount", "target_rate")
        check_within(self, 0, LARGEST, "inverse_temperature", "largest_weight")


class Networks(nn.Module):
    """A policy and its critic: two networks, of which neither sees the other's gradients."""

    policy: PolicyModel  # says logits
    critic: PolicyModel  # says the value, and two Q-values

    def __call__(self, context: Context) -> tuple[Said, Said]:
        """What both say of a context."""
        return self.policy(context), self.critic(context)

    def act(
        self, context: Context, tokens: jax.Array | None = None, deterministic: bool = True
    ) -> Said:
        """What the policy says of a context, given its tokens or not."""
        return self.policy(context, deterministic, tokens=tokens)

    def judge(
        self, context: Context, tokens: tuple[jax.Array, jax.Array], deterministic: bool = True
    ) -> tuple[Said, Said]:
        """What the critic says before and after the step of a transition."""
        return self.critic.transition(context, tokens, deterministic)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the policy's tokens of a context, given those of its past states."""
        return self.policy.encode_next(context, known)

    def encode_transitions(
        self, contexts: Context
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Returns the policy's tokens before the steps of transitions, the critic's around them."""
        earlier = jax.vmap(windows.before)(contexts)
        return self.policy.encode_batch(earlier), self.critic.encode_transitions(contexts)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """IQL as an `Agent`; its energy is minus the policy's logits."""
    settings, choices = setup.settings, setup.domain.num_actions - 1  # the end is not chosen
    critic = setup.make_policy(("value", 1), ("q1", choices), ("q2", choices))
    module = Networks(setup.make_policy(("logits", choices)), critic)
    optimizer = make_optimizer(setup.training)

    def say(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, tokens, method="act")

    def encode(params: Params, target: Params, batch: TransitionWindow) -> PyTree:
        """Tokens of policy and critic, and those of the target network before the steps."""
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
        """Of the value (equation 5), of both Q-functions (6) and of the policy (7)."""
        context = transition.context
        earlier = windows.before(context)
        (seen, around), before = tokens
        options: Any = {"deterministic": False, "rngs": {"dropout": key}}
        policy: Any = module.apply(params, earlier, seen, method="act", **options)
        judged: Any = module.apply(params, context, around, method="judge", **options)
        held: Any = critic.apply(target, earlier, tokens=before)
        now, later = judged
        taken, known = losses.last_actions(context, len(held["value"]), choices)
        least = jnp.minimum(*(losses.of_action(held[name], taken) for name in ("q1", "q2")))

        value, logits = now["value"][:, 0], policy["logits"]
        returns = losses.bellman(transition, later["value"][:, 0], settings.discount)
        each = loss(settings, value, (now["q1"], now["q2"]), least, logits, taken, returns)

        hits = jnp.argmax(logits, axis=1) == taken
        return losses.mean_where(each, known), {
            "accuracy": losses.mean_where(hits, known),
            "value": losses.mean_where(value, known),
            "advantage": losses.mean_where(least - value, known),
        }

    init = make_init(setup, module, apply_to_context, optimizer, target=_critic)
    mean_loss = average_loss(setup, transition_loss, encode)
    update = make_update(
        mean_loss, optimizer, mesh, follow_parameters(settings.target_rate, _critic)
    )
    energy = make_acting_energy(setup, say)
    encode_next = make_encode_next(setup, module, say)
    return Agent(init, transition_batches(setup), update, energy, encode_next)


def loss(
    settings: Settings,
    value: jax.Array,
    qs: Sequence[jax.Array],
    least: jax.Array,
    logits: jax.Array,
    taken: jax.Array,
    returns: jax.Array,
) -> jax.Array:
    """The losses `[P]` of the value (equation 5), of all Q-functions (6) and of the policy (7).

    Args:
        settings: the expectile, and how advantages weigh.
        value: `[P]` of each state.
        qs: Q-values `[P, A - 1]`, each of a function of its own.
        least: `[P]` the least of the target's, of the action that was taken.
        logits: `[P, A - 1]` of the policy.
        taken: `[P]` the actions.
        returns: `[P]` what they gave, and the value of what they led to.
    """
    advantages = jax.lax.stop_gradient(least) - value
    values = losses.expectile(advantages, settings.expectile)
    differences = sum(jnp.square(losses.of_action(q, taken) - returns) for q in qs)
    weights = jnp.exp(settings.inverse_temperature * jax.lax.stop_gradient(advantages))
    likelihoods = losses.of_action(jax.nn.log_softmax(logits), taken)
    return values + differences - jnp.minimum(weights, settings.largest_weight) * likelihoods


def _critic(params: Params) -> Params:
    """The critic's own parameters, as its network has them."""
    return {"params": params["params"]["critic"]}


IQL = Method(Settings, make_agent, rewards=True)
