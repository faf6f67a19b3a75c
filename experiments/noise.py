"""The noise of each method on BabyAI's validation levels: `python -m experiments.noise --help`.

Trains a method, then plays with each temperature. One rule chooses the noise of every method: the
temperature that succeeds most.
"""

import sys
from collections.abc import Sequence

from experiments.common.searches import change_planner
from leapjax.configuration import AnyConfig
from leapjax.planners import BeamConfig
from leapjax.running import main as running
from leapjax.running import shell
from leapjax.running.run import Experiment

# In the units of a method's energy: nats, or Q-values. At 0 the likeliest action is taken.
TEMPERATURES = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, 8.0)
OPTIONS = ("--validation", "--episodes", "500", "--no-pictures")


def try_temperatures(config: AnyConfig) -> list[AnyConfig]:
    """Returns a configuration for each other temperature.

    Beam search draws a single beam at a temperature, as the other methods draw a single action.
    """
    planners = [
        {"temperature": temperature}
        | ({"beams": 1} if temperature and isinstance(config.planner, BeamConfig) else {})
        for temperature in TEMPERATURES
    ]
    return change_planner(config, planners)


EXPERIMENT = Experiment("noise", "babyai", searches=try_temperatures)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every chosen level, method and seed; returns the exit code."""
    return running.main(EXPERIMENT, [*OPTIONS, *shell.read_arguments(arguments)])


if __name__ == "__main__":
    sys.exit(main())
