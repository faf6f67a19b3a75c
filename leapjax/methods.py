"""The table of methods, in which `leapjax.load` and the experiments look up names."""

from typing import Any

from leapjax.agents.base import Method
from leapjax.agents.bc import BC
from leapjax.agents.bcq import BCQ
from leapjax.agents.classifier import CLASSIFIER
from leapjax.agents.cql import CQL
from leapjax.agents.dt import DT
from leapjax.agents.iql import IQL
from leapjax.agents.leap import LEAP
from leapjax.agents.mopo import MOPO
from leapjax.agents.plate import PLATE
from leapjax.agents.qr_dqn import QR_DQN
from leapjax.agents.random import RANDOM
from leapjax.agents.rem import REM
from leapjax.agents.rules import RULES
from leapjax.errors import UserError

METHODS: dict[str, Method] = {
    "leap": LEAP,
    "classifier": CLASSIFIER,
    "bc": BC,
    "dt": DT,
    "bcq": BCQ,
    "iql": IQL,
    "mopo": MOPO,
    "plate": PLATE,
    "cql": CQL,
    "qr_dqn": QR_DQN,
    "rem": REM,
    "rules": RULES,
    "random": RANDOM,
}


def learns_from_rewards(name: str, settings: Any) -> bool:
    """Returns whether a method with these settings learns from rewards: its data must have some."""
    return find_method(name).rewards or getattr(settings, "returns", False)


def find_method(name: str) -> Method:
    """Returns a method by its name.

    Raises:
        UserError: the name is unknown; lists the known names.
    """
    if not isinstance(name, str) or name not in METHODS:
        raise UserError(f"unknown method {name!r}: expected one of {', '.join(METHODS)}")
    return METHODS[name]
