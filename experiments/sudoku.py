"""Sudoku: `python -m experiments.sudoku --help`.

Trains a method on solved boards, then fills new boards with every search, and reports success
against the passes that each search takes.
"""

import sys
from collections.abc import Sequence

from experiments.common.searches import list_searches
from leapjax.running import main as running
from leapjax.running.run import Experiment

EXPERIMENT = Experiment("sudoku", "sudoku", list_searches)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    return running.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
