"""The agent that BC and DT share: it learns which action the demonstrator took in every state."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents import losses
from leapjax.agents.acting import make_acting_energy, make_encode_next
from leapjax.agents.base import Setup
from leapjax.agents.batch_loss import average_loss, make_window_encoder
from leapjax.agents.batches import window_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.returns import ComputeReturns, omit_returns
from leapjax.agents.update import make_init, make_update
from leapjax.models.policy import PolicyModel
from leapjax.types import Agent, Context, Params, PyTree, Window


def make_imitator(
    setup: Setup,
    mesh: Mesh | None,
    compute_returns: ComputeReturns | None = None,
) -> Agent:
    """Makes an agent whose energy is minus the logits of the next action.

    Args:
        setup: arguments of `make_agent`.
        mesh: devices to train on; `None` for one device.
        compute_returns: computes the returns to go that condition the network; `None` for a network
            without this input.
    """
    choices = setup.domain.num_actions - 1  # all but the end action
    module = setup.make_policy(("logits", choices), conditioned=compute_returns is not None)
    compute_returns = compute_returns or omit_returns
    optimizer = make_optimizer(setup.training)

    def apply(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, returns=compute_returns(context), tokens=tokens)

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the mean cross-entropy of a context's actions and the next action."""
        del extra
        outputs: Any = module.apply(
            params, window.context, deterministic=False, rngs={"dropout": key},
            returns=compute_returns(window.context, window.return_to_go), tokens=tokens,
        )  # fmt: skip
        logits = outputs["logits"]  # [P, A - 1]
        taken, known = losses.find_actions_taken(
            window.context, window.actions[0], len(logits), choices
        )
        known = known.at[-1].set(known[-1] & window.imitated[0])
        loss, accuracy = losses.imitation_loss(logits, taken, known)
        return loss, {"accuracy": accuracy}

    def touch(module: PolicyModel, context: Context, actions: jax.Array) -> jax.Array:
        del actions
        return module(context, returns=compute_returns(context, jnp.zeros(())))["logits"]

    mean_loss = average_loss(setup, window_loss, make_window_encoder(module))
    return Agent(
        init=make_init(setup, module, touch, optimizer),
        batch=window_batches(setup),
        update=make_update(mean_loss, optimizer, mesh),
        energy=make_acting_energy(setup, apply),
        encode_next=make_encode_next(setup, module, apply),
    )
