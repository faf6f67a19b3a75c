"""Uniform random actions: the lowest baseline of every table."""

import dataclasses

import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents.base import Method, Setup, make_untrained_agent
from leapjax.energy import single_action
from leapjax.types import Agent, Context, Params, PyTree


@dataclasses.dataclass(frozen=True)
class Settings:
    """Random actions have no options."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes an agent of uniform random actions; its parameters are `()`."""
    del mesh
    setup.check_single_action()
    choices = setup.domain.num_actions - 1

    def encode(params: Params, context: Context) -> PyTree:
        del params, context
        return ()

    energy = single_action(encode, lambda params, memory: jnp.zeros(choices), choices + 1)
    return make_untrained_agent(energy)


RANDOM = Method(Settings, make_agent)
