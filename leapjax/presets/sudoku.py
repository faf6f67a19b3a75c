"""Presets of Sudoku."""

from leapjax.configuration import AnyConfig
from leapjax.domains.puzzles.sudoku import boards
from leapjax.domains.puzzles.sudoku.domain import Settings
from leapjax.presets.puzzles import Puzzle, configure


def paper(name: str, method: str) -> AnyConfig:
    """Returns the paper's training; the paper's network cannot read boards.

    Raises:
        UserError: the level is unknown.
    """
    return configure(_puzzle(name), method, "paper")


def leapjax(name: str, method: str) -> AnyConfig:
    """Returns our network and training.

    Raises:
        UserError: the level is unknown.
    """
    return configure(_puzzle(name), method, "leapjax")


def _puzzle(name: str) -> Puzzle:
    """Returns the numbers of a level; 9 by 9 boards train for twelve minutes on one core."""
    size = boards.find_level(name)
    small = size.side == 4
    training = {
        "steps": 2000 if small else 1500, "batch": 64 if small else 32, "learning_rate": 1e-3,
    }  # fmt: skip
    return Puzzle("sudoku", name, size.cells, 500 if small else 2000, Settings(), training)
