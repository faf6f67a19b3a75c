"""Behaviour cloning: the action that the demonstrator would take next.

The paper's baseline is a causal transformer over the context (section 5, appendix): it is
trained to say every action of the context from what came before.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents import learning
from leapjax.agents.learning import SINGLE_ACTION, Method, Presets, Setup
from leapjax.energy import single_action
from leapjax.models.policy import PolicyModel, past_and_present
from leapjax.types import Agent, Context, Params, PyTree, Window

PRESETS: Presets = {
    "paper": {**SINGLE_ACTION, "architecture": "paper", "dropout": 0.1, "windows": "episode"},
    "leapjax": {
        **SINGLE_ACTION, "architecture": "leapjax", "dropout": 0.0, "windows": "step",
        "learning_rate": 3e-3,
    },
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Settings:
    """Behaviour cloning has no options of its own."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Behaviour cloning as an `Agent`; its energy is minus the logits of the next action."""
    choices = setup.domain.num_actions - 1  # the end action is not chosen
    module = PolicyModel(setup.model, setup.sizes, setup.encoder(), (("logits", choices),))
    optimizer = learning.make_optimizer(setup.training)

    def encode(params: Params, context: Context) -> PyTree:
        return module.apply(params, context)

    def scores(params: Params, memory: PyTree) -> jax.Array:
        del params
        return memory["logits"][-1]

    energy = single_action(
        learning.context_encoder(encode, setup), scores, setup.domain.num_actions
    )

    def window_loss(
        params: Params, extra: PyTree, window: Window, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Cross-entropy of the actions of one context and of the one that followed."""
        del extra
        said: Any = module.apply(params, window.context, deterministic=False, rngs={"dropout": key})
        logits = said["logits"]  # [P, A - 1]
        targets = past_and_present(window.context.actions, window.actions[0], logits.shape[0])
        known = targets < choices  # not where the episode had not begun
        targets = jnp.where(known, targets, 0)
        likelihoods = jnp.take_along_axis(jax.nn.log_softmax(logits), targets[:, None], axis=1)[
            :, 0
        ]
        hits = jnp.argmax(logits, axis=1) == targets
        count = known.sum()
        return -(likelihoods * known).sum() / count, {"accuracy": (hits & known).sum() / count}

    update = learning.make_update(
        window_loss, optimizer, mesh, microbatch=setup.training.microbatch
    )
    init = learning.make_init(setup, module, _say, optimizer)
    return Agent(init, learning.window_batches(setup), update, energy)


def _say(module: PolicyModel, context: Context, actions: jax.Array) -> jax.Array:
    """Touches every parameter, to initialise them."""
    del actions
    return module(context)["logits"]


BC = Method(Settings, make_agent, PRESETS)
