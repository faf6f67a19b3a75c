"""Uniform random actions: the floor of every table."""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents.learning import SINGLE_ACTION, Method, Presets, Setup
from leapjax.energy import single_action
from leapjax.types import Agent, Context, Params, PyTree, TrainState

# There is nothing to learn and nothing to learn it from; at temperature 1 all actions are alike.
NOTHING = {**SINGLE_ACTION, "steps": 0, "demos": 0, "temperature": 1.0}
PRESETS: Presets = {"paper": NOTHING, "leapjax": NOTHING}


@dataclasses.dataclass(frozen=True)
class Settings:
    """There is nothing to choose."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Uniform random actions as an `Agent`, whose parameters are empty."""
    del mesh
    choices = setup.domain.num_actions - 1

    def encode(params: Params, context: Context) -> PyTree:
        del params, context
        return ()

    def init(key: jax.Array) -> TrainState:
        del key
        return TrainState({}, (), jnp.int32(0))

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        del batch, key
        return state._replace(step=state.step + 1), {"loss": jnp.zeros(())}

    energy = single_action(encode, lambda params, memory: jnp.zeros(choices), choices + 1)
    return Agent(init, lambda key, steps: (), update, energy)


RANDOM = Method(Settings, make_agent, PRESETS)
