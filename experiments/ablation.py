"""Energies and planners (paper, appendix, table 8): `python -m experiments.ablation --help`.

The masked model and the LSTM classifier, minimised by random shooting, by the cross-entropy
method and by Gibbs sampling; beside them, of the masked model, two planners that the paper does
not have.
"""

import dataclasses
import sys
from collections.abc import Sequence

from experiments.common import cases
from experiments.common.cases import Analysis, Case, Model, Way
from leapjax.planners import BeamConfig, CrossEntropyConfig, GibbsConfig, ShootingConfig

LEVEL = "GoToObjMazeS4"
ITERATIONS = 30  # the paper's N of this level


def configure_shooting(trained: GibbsConfig) -> ShootingConfig:
    """The best of 30 random plans."""
    return ShootingConfig(trained.horizon)


def configure_cross_entropy(trained: GibbsConfig) -> CrossEntropyConfig:
    """30 plans in each of as many rounds as the paper's Gibbs sampling has iterations."""
    return CrossEntropyConfig(trained.horizon, ITERATIONS)


def configure_gibbs(trained: GibbsConfig) -> GibbsConfig:
    """Algorithm 1, with the paper's N."""
    return dataclasses.replace(trained, iterations=ITERATIONS)


def configure_confident(trained: GibbsConfig) -> GibbsConfig:
    """One action in each pass, the most certain first."""
    return dataclasses.replace(trained, fill="confident", iterations=trained.horizon)


def configure_beams(trained: GibbsConfig) -> BeamConfig:
    """Ten beams, from left to right."""
    return BeamConfig(trained.horizon)


def _make_case(name: str, method: str, paper: tuple[float, float, float], *more: Way) -> Case:
    ways = [
        Way("random shooting", method, search=configure_shooting, paper=paper[0]),
        Way("cross-entropy method", method, search=configure_cross_entropy, paper=paper[1]),
        Way("Gibbs sampling", method, search=configure_gibbs, paper=paper[2]),
        *more,
    ]
    return Case(name, [Model(LEVEL)], LEVEL, ways)


ANALYSIS = Analysis(
    "ablation",
    (
        _make_case(
            "masked-model", "leap", (23.3, 57.5, 62.5),
            Way("most certain first", search=configure_confident),
            Way("beam search", search=configure_beams),
        ),
        _make_case("classifier", "classifier", (25.0, 12.5, 15.5)),
    ),
    timed=True,
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Every case asked for; the exit code."""
    return cases.main(ANALYSIS, arguments)


if __name__ == "__main__":
    sys.exit(main())
