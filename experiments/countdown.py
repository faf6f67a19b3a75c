"""Countdown, reaching a number by arithmetic: `python -m experiments.countdown --help`.

Trains a method to reach targets that it has never seen, then plans with what was trained in every
way that there is, and reports success against the passes of the model that each takes.
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
