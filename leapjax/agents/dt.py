"""Decision Transformer (Chen et al., 2021): behaviour cloning, conditioned on a return.

The network reads the return to go at each state. While acting, the return to go is a target return
minus the return so far.
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
        target_return: Return of an episode to aim for while acting; `None` for a high return of the
            training data (`returns.QUANTILE`).
    """

    target_return: float | None = 1.0

    def __post_init__(self) -> None:
        check_types(self)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a Decision Transformer agent."""
    return make_imitator(setup, mesh, returns.condition_on_target(setup))


DT = Method(Settings, make_agent, rewards=True)
