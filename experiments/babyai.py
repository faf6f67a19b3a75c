"""BabyAI (paper, table 1): `python -m experiments.babyai --help`.

Collects demonstrations, trains a method, plans on held-out levels, and reports the success rate
beside the paper's.
"""

import sys
from collections.abc import Sequence

from experiments.babyai_animation import animate
from experiments.paper import find_success
from leapjax.configuration import AnyConfig, change
from leapjax.domains.babyai.levels import find_level, list_played
from leapjax.running import main as running
from leapjax.running.run import Experiment


def play_members(config: AnyConfig) -> list[AnyConfig]:
    """Returns a configuration for each level that a planner of many levels plays."""
    return [change(config, play=name) for name in list_played(find_level(config.level))]


EXPERIMENT = Experiment(
    "babyai", "babyai", variants=play_members, animate=animate, paper=find_success
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every chosen level and seed; returns the exit code."""
    return running.main(EXPERIMENT, arguments)


if __name__ == "__main__":
    sys.exit(main())
