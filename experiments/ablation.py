"""Energies and planners (paper, appendix, table 12): `python -m experiments.ablation --help`.

Compares random shooting, the cross-entropy method and Gibbs sampling, on the energies of the masked
model and of the LSTM classifier. The masked model also has two planners that the paper does not
test.
"""

import dataclasses
import sys
from collections.abc import Sequence

from experiments.common import cases
from experiments.common.cases import Analysis, Case, Model, Way
from leapjax.planners import BeamConfig, CrossEntropyConfig, GibbsConfig, ShootingConfig

LEVEL = "GoToObjMazeS4"
ITERATIONS = 30  # the paper's N for this level


def configure_shooting(trained: GibbsConfig) -> ShootingConfig:
    """Configures random shooting, which keeps the best of 30 random plans."""
    return ShootingConfig(trained.horizon)


def configure_cross_entropy(trained: GibbsConfig) -> CrossEntropyConfig:
    """Configures the cross-entropy method with 30 plans a round and the paper's N as rounds."""
    return CrossEntropyConfig(trained.horizon, ITERATIONS)


def configure_gibbs(trained: GibbsConfig) -> GibbsConfig:
    """Configures algorithm 1 with the paper's N."""
    return dataclasses.replace(trained, iterations=ITERATIONS)


def configure_confident(trained: GibbsConfig) -> GibbsConfig:
    """Configures one pass for each action, the most certain action first."""
    return dataclasses.replace(trained, fill="confident", iterations=trained.horizon)


def configure_beams(trained: GibbsConfig) -> BeamConfig:
    """Configures beam search with ten beams, from left to right."""
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
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the chosen cases; returns the exit code."""
    return cases.main(ANALYSIS, arguments)


if __name__ == "__main__":
    sys.exit(main())
