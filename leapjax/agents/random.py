"""Uniform random actions: the floor of every table."""

import dataclasses

import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents.learning import SINGLE_ACTION, Method, Presets, Setup, untrained
from leapjax.energy import single_action
from leapjax.types import Agent, Context, Params, PyTree

# There is nothing to learn and nothing to learn it from; at temperature 1 all actions are alike.
NOTHING = {**SINGLE_ACTION, "steps": 0, "demos": 0, "temperature": 1.0}
PRESETS: Presets = {"paper": NOTHING, "leapjax": NOTHING}


@dataclasses.dataclass(frozen=True)
class Settings:
    """There is nothing to choose."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Uniform random actions as an `Agent`, whose parameters are empty."""
    del mesh
    setup.check_single_action()
    choices = setup.domain.num_actions - 1

    def encode(params: Params, context: Context) -> PyTree:
        del params, context
        return ()

    energy = single_action(encode, lambda params, memory: jnp.zeros(choices), choices + 1)
    return untrained(energy)


RANDOM = Method(Settings, make_agent, PRESETS)
