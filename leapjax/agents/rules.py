"""Planning by what a domain knows of itself: its rules as an energy, without any learning."""

import dataclasses

from jax.sharding import Mesh

from leapjax.agents.base import Method, Setup, make_untrained_agent
from leapjax.errors import UserError
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings:
    """There is nothing to choose."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """The domain's rules as an `Agent`.

    Raises:
        UserError: it has none.
    """
    del mesh
    if setup.domain.rules is None:
        raise UserError(
            f"{setup.domain.level} has no rules that are written as an energy: use another method",
            "method",
        )
    return make_untrained_agent(setup.domain.rules)


RULES = Method(Settings, make_agent, everywhere=False)
