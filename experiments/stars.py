"""Star graphs, on which looking ahead pays: `python -m experiments.stars --help`.

Trains a method to find the way to the goal of graphs that it has never seen, then plans with what
was trained in every way that there is, and reports success against the passes of the model that
each takes.
"""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.common import experiment
from experiments.common.config import Config
from experiments.common.experiment import Experiment

AT_ONCE = "all at once"
# By name: options of the planner, and how many times T passes it makes; 0 for one pass.
PLANNERS: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    AT_ONCE: ({}, (0,)),
    "left to right": ({"fill": "sequential"}, (1,)),
    "in random order": ({"fill": "random"}, (1,)),
    "Gibbs, random order": ({"order": "random"}, (1, 2, 4)),
    "Gibbs, sequential order": ({"order": "sequential"}, (1, 2, 4)),
    "Gibbs, least certain first": ({"order": "uncertain"}, (1, 2, 4)),
    "most certain first": ({"fill": "confident"}, (1,)),
    "most certain first, by margin": ({"fill": "margin"}, (1,)),
    "most certain first, then Gibbs": ({"fill": "confident", "order": "uncertain"}, (2,)),
}


def searches(config: Config[Any, Any, Any]) -> list[Mapping[str, Any]]:
    """Every way to plan with LEAP; methods that choose one action at a time have one."""
    if config.method != "leap":
        return []
    return [options for _, _, options in planners(config.planner.horizon)]


def planners(horizon: int) -> list[tuple[str, int, dict[str, Any]]]:
    """Every way to plan T actions: its name, how many times T passes, and options."""
    plain = {"fill": "together", "order": "random"}
    return [
        (name, times, {**plain, **options, "iterations": max(1, times * horizon)})
        for name, (options, several) in PLANNERS.items()
        for times in several
    ]


EXPERIMENT = Experiment("stars", "stars", searches)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    return experiment.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
