"""Presets of Sudoku."""

from leapjax.domains.puzzles.sudoku import boards
from leapjax.domains.puzzles.sudoku.domain import Settings
from leapjax.presets.puzzles import TURNED, Puzzle, make_presets


def describe(name: str, method: str) -> Puzzle:
    """Returns the numbers of a level.

    On one core 9 by 9 boards train for a quarter of an hour, and boards of a range of clues for 70
    minutes.

    Raises:
        UserError: the level is unknown.
    """
    del method
    level = boards.find_level(name)
    if level.side == 4:
        training = {"steps": 2000, "batch": 64, "learning_rate": 1e-3}
        return Puzzle("sudoku", name, level.cells, 500, Settings(), training, search=TURNED)
    steps = 1500 if level.fewest == level.most else 8000
    training = {"steps": steps, "batch": 32, "learning_rate": 2e-3, "microbatch": 8}
    network = {"layers": 8, "width": 96}
    return Puzzle("sudoku", name, level.cells, 3000, Settings(), training, network, TURNED)


paper, leapjax = make_presets(describe)
