"""Satisfiability: `python -m experiments.satisfiability --help`.

Trains a method to satisfy unseen formulas, then plans with the trained energy in every way. Reports
success against passes of the model, beside two classical solvers on the same formulas.
"""

import sys
from collections.abc import Sequence

from experiments.common.searches import list_searches
from experiments.satisfiability_solvers import compare
from leapjax.running import main as running
from leapjax.running.run import Experiment

EXPERIMENT = Experiment("satisfiability", "satisfiability", list_searches, compare=compare)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    return running.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
