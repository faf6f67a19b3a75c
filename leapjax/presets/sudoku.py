"""Presets of Sudoku."""

from leapjax.domains.puzzles.sudoku import boards
from leapjax.domains.puzzles.sudoku.domain import Settings
from leapjax.presets.puzzles import Puzzle, make_presets


def describe(name: str, method: str) -> Puzzle:
    """Returns the numbers of a level; 9 by 9 boards train for twelve minutes on one core.

    Raises:
        UserError: the level is unknown.
    """
    del method
    level = boards.find_level(name)
    small = level.side == 4
    training = {
        "steps": 2000 if small else 1500, "batch": 64 if small else 32, "learning_rate": 1e-3,
    }  # fmt: skip
    return Puzzle("sudoku", name, level.cells, 500 if small else 2000, Settings(), training)


paper, leapjax = make_presets(describe)
