"""Any Gymnasium environment: `python -m experiments.gymnasium --env ID --dataset ID --help`.

Trains a method on a Minari data set of an environment with discrete actions, and plays it.
"""

import sys
from collections.abc import Sequence

from experiments.common import experiment, program
from experiments.common.experiment import Experiment

EXPERIMENT = Experiment("gymnasium", "gymnasium")
# What its users call the options of every experiment.
NAMES = {"--env": "--level", "--dataset": "--demonstrations"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every environment and seed asked for; the exit code."""
    given = program.renamed(program.arguments_of(arguments), NAMES)
    return experiment.main(EXPERIMENT, given)


if __name__ == "__main__":
    sys.exit(main())
