"""Decision Transformer (Chen et al., 2021): the action that leads to a return.

Trained like behaviour cloning, but on what the demonstration gave from each state on. It acts
by asking for a target return, less what the episode has given so far.
"""

import dataclasses

from jax.sharding import Mesh

from leapjax.agents import returns
from leapjax.agents.base import Method, Setup
from leapjax.agents.imitation import make_imitator
from leapjax.checks import check_types
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings:
    """The options of Decision Transformer alone.

    Attributes:
        target_return: Return of an episode that is asked for while acting.
    """

    target_return: float = 1.0

    def __post_init__(self) -> None:
        check_types(self)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Decision Transformer as an `Agent`."""
    return make_imitator(setup, mesh, returns.condition_on_target(setup))


DT = Method(Settings, make_agent, rewards=True)
