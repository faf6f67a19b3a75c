"""PlaTe (Sun et al., 2021): states and actions are predicted in turn; plans by beam search."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents import losses
from leapjax.agents.acting import make_encode
from leapjax.agents.base import Method, Setup
from leapjax.agents.batch_loss import average_loss, make_window_encoder
from leapjax.agents.batches import window_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.update import make_init, make_update
from leapjax.checks import LARGEST, check_types, check_within
from leapjax.data import windows
from leapjax.energy import autoregressive
from leapjax.errors import UserError
from leapjax.models.alternating import AlternatingModel
from leapjax.models.config import MOST_LAYERS
from leapjax.planners import BeamConfig
from leapjax.types import Agent, Context, Params, PyTree, Window


@dataclasses.dataclass(frozen=True)
class Settings:
    """The options of PlaTe alone.

    Attributes:
        state_weight: Weight of the loss of predicted states beside that of actions.
    """

    state_weight: float = 1.0

    def __post_init__(self) -> None:
        check_types(self)
        check_within(self, 0, LARGEST, "state_weight")


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """PlaTe as an `Agent`; its energy is the negative log-likelihood of a plan."""
    sizes, last = setup.sizes, setup.domain.num_actions - 1  # the end action
    if setup.model.architecture != "paper" and setup.horizon > MOST_LAYERS:
        raise UserError(
            f"a horizon of {setup.horizon}: PlaTe with architecture {setup.model.architecture} "
            f"encodes each state of a plan by itself, so its horizon is at most {MOST_LAYERS}",
            "horizon",
        )
    module = AlternatingModel(setup.model, sizes, setup.make_encoder())
    optimizer = make_optimizer(setup.training)

    def encode(params: Params, context: Context) -> PyTree:
        return module.apply(params, context, method="begin")

    def logits(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        result = module.apply(params, memory, actions, positions, method="logits")
        assert isinstance(result, jax.Array)
        # Past an end nothing is chosen, and nothing was learned: the end goes on.
        ended = jnp.cumsum(actions == last) - (actions == last) > 0
        goes_on = jnp.where(jnp.arange(sizes.num_actions) == last, 0.0, -jnp.inf)
        return jnp.where(ended[positions, None], goes_on, result)

    energy = autoregressive(make_encode(setup, encode), logits, sizes.num_actions)

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Cross-entropy of the actions; squared error of the states that they lead to."""
        del extra
        states, actions = module.apply(params, window.context, tokens, method="encode_unrolled")
        found: Any = module.apply(
            params, states, actions, deterministic=False, rngs={"dropout": key}, method="read"
        )
        chosen, led = found
        # Up to the first end: past it nothing is chosen.
        ended = jnp.cumsum(window.actions == last) - (window.actions == last)
        cloning, accuracy = losses.imitation(chosen, window.actions, ended == 0)
        acted = (window.actions < last)[:-1]
        targets = jax.lax.stop_gradient(states[-led.shape[0] :]) if led.shape[0] else led
        errors = ((led - targets) ** 2).mean(axis=1)
        error = jnp.where(acted, errors, 0).sum() / jnp.maximum(acted.sum(), 1)
        loss = cloning + setup.settings.state_weight * error
        return loss, {"accuracy": accuracy, "state_error": error}

    mean_loss = average_loss(setup, window_loss, make_window_encoder(module))
    update = make_update(mean_loss, optimizer, mesh)
    init = make_init(setup, module, _encode_and_score, optimizer)
    return Agent(init, window_batches(setup, windows.unrolled_window), update, energy)


def _encode_and_score(module: AlternatingModel, context: Context, actions: jax.Array) -> PyTree:
    """Touches every parameter, to initialise them."""
    states, before = module.encode(context)
    plan = jnp.concatenate([states, jnp.zeros((actions.shape[0] - 1, states.shape[1]))])
    return module.read(plan, jnp.concatenate([before, actions[:-1]]))


PLATE = Method(Settings, make_agent, planner=BeamConfig)
