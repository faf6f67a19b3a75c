"""The noise of each method on BabyAI's validation levels: `python -m experiments.noise --help`.

Trains a method, then plays with each temperature.
"""

import sys
from collections.abc import Sequence
from typing import Any

from experiments.common.searches import change_planner
from leapjax.configuration import AnyConfig
from leapjax.planners import BeamConfig
from leapjax.running import main as running
from leapjax.running import shell
from leapjax.running.run import Experiment

# In the units of a method's energy: nats, or Q-values. At 0 the likeliest action is taken.
TEMPERATURES = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, 8.0)
EPISODES = 500
OPTIONS = ("--validation", "--episodes", str(EPISODES), "--no-pictures")


def make_noise(temperature: float, kind: type) -> dict[str, Any]:
    """Makes the fields of a planner that draws actions at a temperature.

    Beam search draws a single beam, as the other methods draw a single action.

    Args:
        temperature: temperature; 0 takes the likeliest actions.
        kind: type of the planner's configuration.
    """
    beams = {"beams": 1} if temperature and issubclass(kind, BeamConfig) else {}
    return {"temperature": temperature, **beams}


def try_temperatures(config: AnyConfig) -> list[AnyConfig]:
    """Returns a configuration for each other temperature."""
    kind = type(config.planner)
    return change_planner(config, [make_noise(each, kind) for each in TEMPERATURES])


EXPERIMENT = Experiment("noise", "babyai", variants=try_temperatures)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every chosen level, method and seed; returns the exit code."""
    return running.main(EXPERIMENT, [*OPTIONS, *shell.read_arguments(arguments)])


if __name__ == "__main__":
    sys.exit(main())
