"""Sudoku: `python -m experiments.sudoku --help`."""

import sys
from collections.abc import Sequence

from experiments.common import experiment
from experiments.common.experiment import Experiment
from experiments.stars import searches

EXPERIMENT = Experiment("sudoku", "sudoku", searches)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    return experiment.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
