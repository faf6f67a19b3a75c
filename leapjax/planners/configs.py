"""The configurations of planners: frozen dataclasses that name strategies and hold numbers."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from leapjax.checks import check_at_least, check_number, check_types
from leapjax.errors import UserError
from leapjax.planners.judges import JUDGES
from leapjax.planners.positions import SELECTIONS, Commitment, Select
from leapjax.types import Energy

# The files and command lines that hold a configuration name a strategy; programs may pass a
# function of their own.
if TYPE_CHECKING:
    Fill = str | Select
else:
    Fill = str

HOTTEST = 1e30  # a limit so that temperature times noise stays finite
FILLS = ("together", *SELECTIONS)
ORDERS = ("random", "sequential", "uncertain")
KEPT = ("last", "best")


def check_temperature(temperature: float) -> None:
    """Checks a temperature.

    Raises:
        ValueError: the temperature is not a number, is negative or NaN, or is too large.
    """
    check_number("a temperature", temperature, 0, HOTTEST)


def check_name(field: str, value: Any, known: Sequence[str]) -> None:
    """Checks the name of a strategy.

    Raises:
        ValueError: the name is unknown.
    """
    if value not in known:
        raise ValueError(f"unknown {field} {value!r}: expected one of {', '.join(known)}")


@dataclasses.dataclass(frozen=True)
class GibbsConfig:
    """Iterative planning through energy minimisation (paper, algorithm 1).

    Attributes:
        horizon: T, planned actions.
        iterations: N, passes of the model at most, including the fill.
        resampled: P, positions that a pass chooses together, unless it fills all.
        fill: How passes fill the first plan. "together" fills all positions in one pass, as in the
            paper. The other names fill P positions in each pass, while the rest stay MASK.
            "confident" takes positions with the likeliest actions first, "margin" positions whose
            likeliest action leads the second by most. "sequential" goes from left to right, and
            "random" in random order. A program may pass a function (energies `[T, A]`, key) ->
            ranks `[T]`; the highest rank comes first. Rows of filled positions hold no energies
            of theirs, so rank each position by its own row.
        order: Which P positions every later iteration resamples. "random" draws them, "sequential"
            goes from left to right, and "uncertain" takes positions that were least certain when
            they were chosen. It resamples each once before it resamples any again.
        temperature: Temperature at which actions are drawn; 0 takes the most likely action.
        restarts: R, plans at most; the planner returns the one that the judge likes best. If the
            energy knows symmetries, each restart sees the context turned.
        score: Also return the energy of the plan, for T more passes.
        score_trace: Also return the energy after every iteration, for N * T more passes.
        certainty: A filling pass also fills each next position whose likeliest action has at least
            this probability. Then the plan takes fewer passes. 1 fills P positions.
        entropy_bound: A filling pass also fills each next position, as long as their entropies
            without the largest add up to at most this, in nats (EB-Sampler, arXiv 2505.24857). 0
            fills P positions.
        cool_to: Temperature of the last iteration; it changes linearly after the first plan. By
            default the temperature is constant.
        keep: Which plan of the trace to return: the "last", or the "best" after the fill, for which
            the judge scores all of these plans.
        judge: What compares plans. "energy" takes the least total energy, for T passes a plan.
            "halves" takes the least energy of actions with half of the plan in view, for 6 passes,
            plus the violation of constraints.
        enough: Restarts stop once the judge gives a plan at most this, in nats. By default all run.
    """

    horizon: int = 5
    iterations: int = 10
    resampled: int = 1
    fill: Fill = "together"
    order: str = "random"
    temperature: float = 0.0
    restarts: int = 1
    score: bool = False
    score_trace: bool = False
    certainty: float = 1.0
    entropy_bound: float = 0.0
    cool_to: float | None = None
    keep: str = "last"
    judge: str = "energy"
    enough: float | None = None

    def __post_init__(self) -> None:
        check_types(self, strategies=("fill",))
        check_at_least(self, 1, "horizon", "iterations", "resampled", "restarts")
        if self.resampled > self.horizon:
            raise ValueError(
                f"resampled is {self.resampled}, more positions than the horizon {self.horizon}"
            )
        check_temperature(self.temperature)
        check_fill(self, FILLS)
        if self.cool_to is not None:
            check_temperature(self.cool_to)
        check_name("order", self.order, ORDERS)
        check_name("keep", self.keep, KEPT)
        check_name("judge", self.judge, tuple(JUDGES))
        if self.enough is not None:
            check_number("enough", self.enough)
            if self.restarts == 1:
                raise ValueError("enough stops restarts, and there is one plan: set restarts")
        if self.iterations < self.fill_iterations:
            raise ValueError(
                f"fill {self.fill!r} chooses {self.resampled} of {self.horizon} actions in a pass, "
                f"so it needs {self.fill_iterations} iterations, got {self.iterations}"
            )

    @property
    def fill_iterations(self) -> int:
        """The passes after which no position is MASK, at most."""
        return 1 if self.fill == "together" else -(-self.horizon // self.resampled)

    @property
    def returnable(self) -> int:
        """The last plans of a trace, which may be returned: all complete plans, or one."""
        return self.iterations - self.fill_iterations + 1 if self.keep == "best" else 1

    @property
    def is_judged(self) -> bool:
        """Whether there are several plans to compare."""
        return self.restarts > 1 or self.keep == "best"


def check_fill(config: "GibbsConfig | BeamConfig", known: Sequence[str]) -> None:
    """Checks how a configuration fills plans.

    Raises:
        ValueError: an unknown name, or a bound out of range.
    """
    if not callable(config.fill):
        check_name("fill", config.fill, known)
    check_number("certainty", config.certainty, 0, 1)
    check_number("entropy_bound", config.entropy_bound, 0)
    if config.fill == "together" and make_commitment(config).adapts:
        raise ValueError(
            "certainty and entropy_bound choose how many positions a pass fills, and fill "
            "'together' fills all: use another fill, such as 'confident'"
        )


def make_commitment(config: "GibbsConfig | BeamConfig") -> Commitment:
    """Returns how many positions a filling pass of a configuration fills."""
    least = config.resampled if isinstance(config, GibbsConfig) else 1
    return Commitment(least, config.certainty, config.entropy_bound)


def find_selection(fill: Fill) -> Select:
    """Returns the function that a configuration names or holds."""
    return fill if callable(fill) else SELECTIONS[fill]


@dataclasses.dataclass(frozen=True)
class ShootingConfig:
    """Random shooting (paper, appendix, ablation): the best of random plans.

    Attributes:
        horizon: T, planned actions.
        candidates: Uniformly drawn plans; the planner returns the plan of least energy.
        score: Also return the energy of the plan, which is known anyway.
    """

    horizon: int = 5
    candidates: int = 30
    score: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "horizon", "candidates")


@dataclasses.dataclass(frozen=True)
class CrossEntropyConfig:
    """The cross-entropy method as the paper's appendix describes it.

    Attributes:
        horizon: T, planned actions.
        iterations: N, rounds; the first draws uniform plans.
        candidates: Plans in each round.
        elites: Plans of least energy. They survive, and are the parents of the next round: each
            child changes one action.
        score: Also return the energy of the plan.
    """

    horizon: int = 5
    iterations: int = 10
    candidates: int = 30
    elites: int = 3
    score: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "horizon", "iterations", "candidates", "elites")
        if self.elites > self.candidates:
            raise ValueError(f"{self.elites} elites out of {self.candidates} candidates")


@dataclasses.dataclass(frozen=True)
class BeamConfig:
    """Beam search: W partial plans branch, each at its next position, and the best W go on.

    Attributes:
        horizon: T, planned actions.
        beams: W, partial plans that are kept.
        temperature: 0 keeps the best beams; above it beams are drawn, all different.
        score: Also return the energy of the plan, for T more passes.
        fill: Which open position a beam chooses next, as in `GibbsConfig`. By default beams go from
            left to right; in other orders each beam takes a position of its own.
        judge: Which complete beam to return. "sum" takes the least sum of the conditional energies
            of its choices; "energy" and "halves" as in `GibbsConfig`.
        certainty: As in `GibbsConfig`: a pass also fills each next position that is so certain. The
            beam branches at the last of them.
        entropy_bound: As in `GibbsConfig`; the beam branches at the last position.
    """

    horizon: int = 5
    beams: int = 10
    temperature: float = 0.0
    score: bool = False
    fill: Fill = "sequential"
    judge: str = "sum"
    certainty: float = 1.0
    entropy_bound: float = 0.0

    def __post_init__(self) -> None:
        check_types(self, strategies=("fill",))
        check_at_least(self, 1, "horizon", "beams")
        check_temperature(self.temperature)
        check_fill(self, tuple(SELECTIONS))
        check_name("judge", self.judge, ("sum", *JUDGES))
        if self.temperature and make_commitment(self).adapts:
            raise ValueError(
                "certainty and entropy_bound take the most likely actions, and a temperature "
                "draws them: use one of the two"
            )

    @property
    def iterations(self) -> int:
        """Passes at most: each chooses at least one action of every plan."""
        return self.horizon


PlannerConfig = GibbsConfig | ShootingConfig | CrossEntropyConfig | BeamConfig


def check_masks(energy: Energy, config: PlannerConfig) -> None:
    """Checks that an energy accepts MASK where a planner puts it.

    Raises:
        UserError: it does not; names the field of the configuration to change.
    """
    if energy.accepts_mask or not isinstance(config, GibbsConfig | BeamConfig):
        return
    refused = "and this energy does not accept it (accepts_mask is False)"
    ordered = config.fill == "sequential" and not make_commitment(config).adapts
    if isinstance(config, GibbsConfig) and config.fill != "together":
        raise UserError(
            f"fill {config.fill!r} leaves MASK in a plan, {refused}: use fill 'together'", "fill"
        )
    if isinstance(config, BeamConfig) and not energy.left_to_right:
        raise UserError(f"beam search leaves MASK in a plan, {refused}: use another planner")
    if isinstance(config, BeamConfig) and not ordered:
        raise UserError(
            "this energy reads a plan from left to right: use fill 'sequential', without certainty "
            "and entropy_bound",
            "fill",
        )
    if config.judge in JUDGES and JUDGES[config.judge].masks:
        raise UserError(
            f"judge {config.judge!r} masks actions, {refused}: use judge 'energy'", "judge"
        )


def passes_vary(config: PlannerConfig) -> bool:
    """Returns whether some plans take fewer passes than others with the same configuration."""
    if isinstance(config, GibbsConfig):
        return make_commitment(config).adapts or config.enough is not None
    return isinstance(config, BeamConfig) and make_commitment(config).adapts


def count_plans(config: PlannerConfig) -> int:
    """Returns the number of plans of one context that a planner makes at a time."""
    if isinstance(config, GibbsConfig):
        return config.restarts if config.enough is None else 1  # or else one after the other
    return config.beams if isinstance(config, BeamConfig) else config.candidates


def needs_totals(config: PlannerConfig) -> bool:
    """Returns whether a planner computes total energies."""
    if isinstance(config, GibbsConfig):
        return config.score or (config.is_judged and config.judge == "energy")
    return not isinstance(config, BeamConfig) or config.score or config.judge == "energy"
