"""Presets of Countdown."""

from leapjax.domains.puzzles.countdown import problems
from leapjax.domains.puzzles.countdown.domain import Settings
from leapjax.presets.puzzles import Puzzle, make_presets

DEMONSTRATIONS = 20000
TRAINING = {"steps": 4000, "batch": 128, "learning_rate": 1e-3}


def describe(name: str, method: str) -> Puzzle:
    """Returns the numbers of a level.

    Raises:
        UserError: the level is unknown.
    """
    del method
    length = problems.find_level(name).length
    return Puzzle("countdown", name, length, DEMONSTRATIONS, Settings(), TRAINING)


paper, leapjax = make_presets(describe)
