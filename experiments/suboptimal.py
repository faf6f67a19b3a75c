"""Imperfect demonstrations (paper, table 2): `python -m experiments.suboptimal --help`.

A quarter of the demonstrator's actions are random. On levels `...Mistakes` it executes them, and
goes on from there. On levels `...Mislabelled` only the recorded actions are wrong, as the file of
the paper's authors suggests.
"""

import dataclasses
import sys
from collections.abc import Sequence

from experiments.common import cases
from experiments.common.cases import NOISE, Analysis, Case, Model, Way
from leapjax.planners import GibbsConfig

# The paper's success of (LEAP, DT) in percent: from optimal, then from imperfect demonstrations.
PAPER = {
    "GoToObjMazeS4": ((65.0, 46.5), (63.0, 45.0)),
    "GoToObjMazeS7": ((45.5, 22.0), (44.0, 19.5)),
    "GoToSeqS5R2": ((38.0, 26.5), (37.5, 29.5)),
}


def lower_temperature(trained: GibbsConfig) -> GibbsConfig:
    """Limits the temperature to 0.5: at 1, plans have as many mistakes as demonstrations."""
    return dataclasses.replace(trained, temperature=min(trained.temperature, 0.5))


def _make_case(level: str, suffix: str, leap: float, dt: float) -> Case:
    whole = Way("whole plans", paper=leap)
    if suffix:
        whole = whole._replace(search=lower_temperature)
    three = whole._replace(name="three actions of each plan", executed=3)
    ways = [whole, three, Way("dt", "dt", paper=dt)]
    ways.append(Way("dt, with noise", "dt", search=NOISE))
    return Case(f"{level}{suffix}", [Model(f"{level}{suffix}")], level, ways)


ANALYSIS = Analysis(
    "suboptimal",
    [
        _make_case(level, suffix, *paper)
        for level, (optimal, mistaken) in PAPER.items()
        for suffix, paper in {"": optimal, "Mistakes": mistaken, "Mislabelled": mistaken}.items()
    ],
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the chosen cases; returns the exit code."""
    return cases.main(ANALYSIS, arguments)


if __name__ == "__main__":
    sys.exit(main())
