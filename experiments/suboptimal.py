"""Imperfect demonstrations (paper, appendix): `python -m experiments.suboptimal --help`.

A quarter of the demonstrator's actions are random. They are executed, and it goes on from where
they lead; or, as the file of the paper's authors suggests, only what is recorded is wrong.
"""

import dataclasses
import sys
from collections.abc import Sequence

from experiments.common import cases
from experiments.common.cases import NOISE, Analysis, Case, Model, Way
from leapjax.planners import GibbsConfig

# The paper's success of LEAP and DT, from optimal demonstrations and from others.
PAPER = {
    "GoToObjMazeS4": ((65.0, 46.5), (63.0, 45.0)),
    "GoToObjMazeS7": ((45.5, 22.0), (44.0, 19.5)),
    "GoToSeqS5R2": ((38.0, 26.5), (37.5, 29.5)),
}


def lower_temperature(trained: GibbsConfig) -> GibbsConfig:
    """Plans are samples: drawn at the temperature of sequences, they have as many mistakes."""
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
    """Every case asked for; the exit code."""
    return cases.main(ANALYSIS, arguments)


if __name__ == "__main__":
    sys.exit(main())
