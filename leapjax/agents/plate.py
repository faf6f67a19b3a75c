"""PlaTe (Sun et al., 2021): it predicts states and actions in turn, and plans by beam search."""

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
        state_weight: Weight of the loss of predicted states; the loss of actions has weight 1.
    """

    state_weight: float = 1.0

    def __post_init__(self) -> None:
        check_types(self)
        check_within(self, 0, LARGEST, "state_weight")


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a PlaTe agent; its energy is the negative log-likelihood of a plan."""
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
        return module.apply(params, context, method="make_memory")

    def logits(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        result = module.apply(params, memory, actions, positions, method="logits")
        assert isinstance(result, jax.Array)
        # Only the end can follow an end; training skips these positions.
        ended = jnp.cumsum(actions == last) - (actions == last) > 0
        goes_on = jnp.where(jnp.arange(sizes.num_actions) == last, 0.0, -jnp.inf)
        return jnp.where(ended[positions, None], goes_on, result)

    energy = autoregressive(make_encode(setup, encode), logits, sizes.num_actions)

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Sums the cross-entropy of actions and the squared errors of predicted states."""
        del extra
        states, actions = module.apply(params, window.context, tokens, method="encode_unrolled")
        outputs: Any = module.apply(
            params, states, actions, deterministic=False, rngs={"dropout": key}, method="read"
        )
        logits, predicted = outputs
        # The loss counts actions up to the first end.
        ended = jnp.cumsum(window.actions == last) - (window.actions == last)
        cloning, accuracy = losses.imitation_loss(
            logits, window.actions, (ended == 0) & window.imitated
        )
        acted = (window.actions < last)[:-1]
        targets = (
            jax.lax.stop_gradient(states[-predicted.shape[0] :])
            if predicted.shape[0]
            else predicted
        )
        errors = ((predicted - targets) ** 2).mean(axis=1)
        error = jnp.where(acted, errors, 0).sum() / jnp.maximum(acted.sum(), 1)
        loss = cloning + setup.settings.state_weight * error
        return loss, {"accuracy": accuracy, "state_error": error}

    mean_loss = average_loss(setup, window_loss, make_window_encoder(module))
    update = make_update(mean_loss, optimizer, mesh)
    init = make_init(setup, module, _encode_and_score, optimizer)
    return Agent(init, window_batches(setup, windows.unrolled_window), update, energy)


def _encode_and_score(module: AlternatingModel, context: Context, actions: jax.Array) -> PyTree:
    """Uses every parameter, so that `make_init` initialises all of them."""
    states, before = module.encode(context)
    plan = jnp.concatenate([states, jnp.zeros((actions.shape[0] - 1, states.shape[1]))])
    return module.read(plan, jnp.concatenate([before, actions[:-1]]))


PLATE = Method(Settings, make_agent, planner=BeamConfig)
