"""Makes hard boards to play: `python -m experiments.sudoku_mixture sudoku17.txt boards.txt`.

Recurrent Relational Networks (Palm et al., 2018) are tested on boards with 17 to 34 clues, equally
many of each. Clues beyond 17 are digits of the solution at random open cells.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from leapjax import files
from leapjax.checks import check_at_least
from leapjax.domains.puzzles.common import PuzzleFile
from leapjax.domains.puzzles.sudoku import boards
from leapjax.errors import UserError
from leapjax.running import shell

FEWEST, MOST = 17, 34  # clues


@dataclasses.dataclass(frozen=True)
class Options:
    """Make boards of 17 to 34 clues from boards of 17, for `experiments.sudoku --boards`."""

    source: Annotated[Path, tyro.conf.Positional]
    """Text file of boards with 17 clues, one a line, such as Gordon Royle's."""
    target: Annotated[Path, tyro.conf.Positional]
    """Text file to write."""
    count: int = 360
    """Boards to make."""
    seed: int = 0
    """Seed that draws boards and clues."""

    def __post_init__(self) -> None:
        check_at_least(self, 1, "count")
        check_at_least(self, 0, "seed")


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the boards; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.sudoku_mixture", given)
    return shell.run_program("experiments.sudoku_mixture", given, lambda: write_boards(options))


def write_boards(options: Options) -> None:
    """Writes the boards of a mixture.

    Raises:
        UserError: the source has too few boards, or a board without exactly 17 clues or without
            exactly one solution.
    """
    source = PuzzleFile(options.source, "boards", lambda text: boards.read_board(text, 9))
    lines = source.lines
    if len(lines) < options.count:
        raise UserError(
            f"{options.source} has {len(lines)} boards: expected at least {options.count}", "count"
        )
    rng = np.random.default_rng(options.seed)
    made = []
    for index, place in enumerate(rng.permutation(len(lines))[: options.count]):
        clues, solution = source.read_line(int(place))
        if (clues > 0).sum() != FEWEST:
            raise UserError(
                f"{options.source}, line {lines[place][0]}: {(clues > 0).sum()} clues, expected "
                f"{FEWEST}"
            )
        extra = index % (MOST - FEWEST + 1)
        chosen = rng.permutation(np.flatnonzero(clues == 0))[:extra]
        board = clues.copy()
        board[chosen] = solution[chosen]
        made.append("".join(map(str, board)))
    files.write_text(options.target, "\n".join(made) + "\n")
    print(f"{options.target}: {len(made)} boards")


if __name__ == "__main__":
    sys.exit(main())
