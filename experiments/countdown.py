"""Countdown, reaching a number by arithmetic: `python -m experiments.countdown --help`.

Trains a method on some targets, and plays other targets. It plans in every way that there is, and
reports success against the passes of the model.
"""

import sys
from collections.abc import Sequence

from experiments.common.searches import list_searches
from leapjax.running import main as running
from leapjax.running.run import Experiment

EXPERIMENT = Experiment("countdown", "countdown", list_searches)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    return running.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
