"""Behaviour cloning: predicts the demonstrator's next action.

The paper's baseline is a causal transformer over the context (section 5, appendix). It learns to
predict every action of the context from the states and actions before it.
"""

import dataclasses

from jax.sharding import Mesh

from leapjax.agents.base import Method, Setup
from leapjax.agents.imitation import make_imitator
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings:
    """Behaviour cloning has no options of its own."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes an agent of behaviour cloning."""
    return make_imitator(setup, mesh)


BC = Method(Settings, make_agent)
