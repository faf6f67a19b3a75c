"""Turns that fail (paper, appendix): `python -m experiments.stochastic --help`.

With probability 0.2 a turn becomes any of the five other actions, in demonstrations and in tests.
"""

import sys
from collections.abc import Sequence

from experiments.common import cases
from experiments.common.cases import NOISE, Analysis, Case, Model, Way


def _make_case(level: str, leap: float, dt: float) -> Case:
    return Case(
        level,
        [Model(f"{level}Slip")],
        f"{level}Slip",
        [
            Way("whole plans", paper=leap),
            Way("replanned after each action", executed=1, paper=leap),
            Way("dt", "dt", paper=dt),
            Way("dt, with noise", "dt", search=NOISE),
        ],
    )


ANALYSIS = Analysis(
    "stochastic", (_make_case("GoToObjMazeS4", 57.5, 30.8), _make_case("GoToObjMazeS7", 33.3, 28.3))
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the chosen cases; returns the exit code."""
    return cases.main(ANALYSIS, arguments)


if __name__ == "__main__":
    sys.exit(main())
