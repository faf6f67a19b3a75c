"""Presets of satisfiability."""

from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.satisfiability.domain import Settings
from leapjax.presets.puzzles import Puzzle, make_presets

DEMONSTRATIONS = 2000
TRAINING = {"steps": 2000, "batch": 32, "learning_rate": 2e-3}
# Messages find what variables share, so a small network is enough; it trains in ten minutes on a
# core. Chosen on validation levels of Sat20x91.
NETWORK = {"layers": 2, "heads": 2, "width": 64}


def describe(name: str, method: str) -> Puzzle:
    """Returns the numbers of a level.

    Raises:
        UserError: the level is unknown.
    """
    del method
    length = formulas.find_level(name).variables
    return Puzzle("satisfiability", name, length, DEMONSTRATIONS, Settings(), TRAINING, NETWORK)


paper, leapjax = make_presets(describe)
