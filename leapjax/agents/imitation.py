"""What BC and DT share: an agent that learns which action was taken, of every state."""

from typing import Any

import jax
from jax.sharding import Mesh

from leapjax.agents import learning, losses
from leapjax.agents.batches import window_batches
from leapjax.agents.learning import Setup
from leapjax.agents.returns import Returns, nothing_wanted
from leapjax.models.policy import PolicyModel
from leapjax.types import Agent, Context, Params, PyTree, Window


def make_imitator(
    setup: Setup,
    mesh: Mesh | None,
    wanted: Returns | None = None,
) -> Agent:
    """An agent whose energy is minus the logits of the next action.

    Args:
        setup: what it is made from.
        mesh: of devices to train on; None for one device.
        wanted: the returns that the action is conditioned on; None: on nothing else.
    """
    choices = setup.domain.num_actions - 1  # the end action is not chosen
    module = setup.policy(("logits", choices), conditioned=wanted is not None)
    wanted = wanted or nothing_wanted
    optimizer = learning.make_optimizer(setup.training)

    def say(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, returns=wanted(context), tokens=tokens)

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Cross-entropy of the actions of one context and of the one that followed."""
        del extra
        said: Any = module.apply(
            params, window.context, deterministic=False, rngs={"dropout": key},
            returns=wanted(window.context, window.return_to_go), tokens=tokens,
        )  # fmt: skip
        logits = said["logits"]  # [P, A - 1]
        taken = losses.actions_taken(window.context, window.actions[0], len(logits), choices)
        loss, accuracy = losses.imitation(logits, *taken)
        return loss, {"accuracy": accuracy}

    def touch(module: PolicyModel, context: Context, actions: jax.Array) -> jax.Array:
        del actions
        return module(context, returns=wanted(context))["logits"]

    mean_loss = learning.average_loss(setup, window_loss, learning.encode_windows(module))
    update = learning.make_update(mean_loss, optimizer, mesh)
    init = learning.make_init(setup, module, touch, optimizer)
    energy = learning.acting_energy(setup, say)
    encode_next = learning.make_encode_next(setup, module, say)
    return Agent(init, window_batches(setup), update, energy, encode_next)
