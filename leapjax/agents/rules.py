"""Plans by a domain's rules, which are written as an energy; needs no training data."""

import dataclasses

from jax.sharding import Mesh

from leapjax.agents.base import Method, Setup, make_untrained_agent
from leapjax.errors import UserError
from leapjax.types import Agent


@dataclasses.dataclass(frozen=True)
class Settings:
    """Rules have no options."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes an agent of the domain's rules.

    Raises:
        UserError: the domain has no rules.
    """
    del mesh
    if setup.domain.rules is None:
        raise UserError(
            f"{setup.domain.level} has no rules that are written as an energy: use another method",
            "method",
        )
    return make_untrained_agent(setup.domain.rules)


RULES = Method(Settings, make_agent, everywhere=False)
