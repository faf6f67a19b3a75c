"""Decision Transformer (Chen et al., 2021): behaviour cloning, conditioned on a return.

The network reads the return to go at each state. While acting, the return to go is a target return
minus the return so far.
"""

import dataclasses

from jax.sharding import Mesh

from leapjax.agents import returns
from leapjax.agents.base import Method, Setup
from leapjax.agents.imitation import make_imitator
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings(returns.ReturnSettings):
    """The options of Decision Transformer."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a Decision Transformer agent."""
    return make_imitator(setup, mesh, returns.condition_on_target(setup))


DT = Method(Settings, make_agent, rewards=True)
