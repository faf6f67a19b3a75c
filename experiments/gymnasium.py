"""Any Gymnasium environment: `python -m experiments.gymnasium --env ID --dataset ID --help`.

Trains a method on a Minari data set of an environment with discrete actions, and plays episodes.
"""

import sys
from collections.abc import Sequence

from leapjax.running import main as running
from leapjax.running.run import Experiment
from leapjax.running.spelling import GymnasiumConfig

EXPERIMENT = Experiment("gymnasium", "gymnasium", config=GymnasiumConfig)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every chosen environment and seed; returns the exit code."""
    return running.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
