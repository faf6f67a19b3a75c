"""Any Gymnasium environment: `python -m experiments.gymnasium --env ID --dataset ID --help`.

Trains a method on a Minari data set of an environment with discrete actions, and plays it.
"""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from experiments.common import config, experiment
from experiments.common.config import D, M, P
from experiments.common.experiment import Experiment


@dataclasses.dataclass(frozen=True)
class Config(config.Config[M, D, P]):
    """Train a method on a Minari data set of an environment, then measure its success.

    Attributes:
        level: Id of a Gymnasium environment with discrete actions, or module:id to import the
            module first. Without it, the environment that the data set names.
        demonstrations: Id of a Minari data set of the environment to train on.
        play: Environment to play instead of the one that the planner of a checkpoint was trained
            on.
    """

    level: Annotated[str, tyro.conf.arg(name="env")]
    demonstrations: Annotated[str | None, tyro.conf.arg(name="dataset")] = None


EXPERIMENT = Experiment("gymnasium", "gymnasium", config=Config)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every environment and seed asked for; the exit code."""
    return experiment.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
