"""Batch-constrained Q-learning for discrete actions (Fujimoto et al., 2019).

A Q-function is learned from transitions, whose best next action is sought only among those that
the data make likely: the ones it knows the value of. It acts the same way.
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
from leapjax.agents.q_learning import encode_around, look_around
from leapjax.agents.update import apply_to_context, follow_parameters, make_init, make_update
from leapjax.checks import LARGEST, check_types, check_within
from leapjax.models.policy import Said
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


@dataclasses.dataclass(frozen=True)
class Settings:
    """The options of BCQ alone. The defaults are the original's, but for the target network.

    Attributes:
        threshold: Actions less likely than this share of the likeliest are excluded.
        discount: Discount of rewards per step.
        target_rate: How far the target network moves towards the network at each step, in 0 .. 1.
        logit_penalty: Weight of the squares of the behaviour model's logits in the loss.
    """

    threshold: float = 0.3
    discount: float = 0.99
    target_rate: float = 0.005
    logit_penalty: float = 0.01

    def __post_init__(self) -> None:
        check_types(self)
        check_within(self, 0, 1, "threshold", "discount", "target_rate")
        check_within(self, 0, LARGEST, "logit_penalty")


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """BCQ as an `Agent`; its energy is minus the Q-values of the actions that are likely."""
    settings, choices = setup.settings, setup.domain.num_actions - 1  # the end is not chosen
    module = setup.make_policy(("q", choices), ("behaviour", choices))
    optimizer = make_optimizer(setup.training)

    def say(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, tokens=tokens)

    def likely(said: Said) -> jax.Array:
        return likely_values(said, settings.threshold)

    def transition_loss(
        params: Params,
        target: PyTree,
        transition: TransitionWindow,
        tokens: PyTree,
        key: jax.Array,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The temporal difference of Q, and the cross-entropy of the behaviour."""
        context = transition.context
        now, later, held = look_around(module, params, target, context, tokens, key)
        # Chosen by the one network and valued by the other, as in double Q-learning.
        best = jnp.argmax(likely(later), axis=1)
        values = losses.of_action(held["q"], best)  # [P]
        taken, known = losses.last_actions(context, len(values), choices)
        targets = losses.bellman(transition, values, settings.discount)
        estimates = losses.of_action(now["q"], taken)
        errors = optax.losses.huber_loss(estimates, targets)
        cloning, accuracy = losses.imitation(now["behaviour"], taken, known)
        squares = (now["behaviour"] ** 2).mean(axis=1)
        loss = losses.mean_where(errors + settings.logit_penalty * squares, known) + cloning
        return loss, {"accuracy": accuracy, "value": losses.mean_where(estimates, known)}

    init = make_init(setup, module, apply_to_context, optimizer, target=lambda params: params)
    mean_loss = average_loss(setup, transition_loss, encode_around(module))
    update = make_update(mean_loss, optimizer, mesh, follow_parameters(settings.target_rate))
    energy = make_acting_energy(setup, say, likely)
    encode_next = make_encode_next(setup, module, say)
    return Agent(init, transition_batches(setup), update, energy, encode_next)


def likely_values(said: Said, threshold: float) -> jax.Array:
    """`[P, A - 1]` Q-values, -inf where an action is less likely than it may be."""
    likelihoods = jax.nn.softmax(said["behaviour"])
    likely = likelihoods >= threshold * likelihoods.max(axis=1, keepdims=True)
    return jnp.where(likely, said["q"], -jnp.inf)


BCQ = Method(Settings, make_agent, rewards=True)
