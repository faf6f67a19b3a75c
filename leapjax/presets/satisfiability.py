"""Presets of satisfiability."""

from leapjax.configuration import AnyConfig
from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.satisfiability.domain import Settings
from leapjax.presets.puzzles import Puzzle, configure

DEMONSTRATIONS = 2000
TRAINING = {"steps": 2000, "batch": 64, "learning_rate": 1e-3}


def paper(name: str, method: str) -> AnyConfig:
    """The paper's training; its network reads no formulas.

    Raises:
        UserError: an unknown level.
    """
    return configure(_puzzle(name), method, "paper")


def leapjax(name: str, method: str) -> AnyConfig:
    """Our network.

    Raises:
        UserError: an unknown level.
    """
    return configure(_puzzle(name), method, "leapjax")


def _puzzle(name: str) -> Puzzle:
    length = formulas.find_level(name).variables
    return Puzzle("satisfiability", name, length, DEMONSTRATIONS, Settings(), TRAINING)
