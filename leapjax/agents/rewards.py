"""The options of methods that learn values, and the scale of their rewards."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from leapjax.checks import check_types, check_within
from leapjax.types import Demonstration


@dataclasses.dataclass(frozen=True)
class ValueSettings:
    """The options of every method that learns values.

    Rewards are scaled, because one learning rate suits values of one size. The target network moves
    a little at every step. The originals of CQL, QR-DQN and REM copy the network to it instead,
    every 8,000 steps (Agarwal et al.) or every 2,000 steps (d3rlpy).

    Attributes:
        discount: Discount of rewards per step.
        reward_scale: Divisor of rewards; `None` takes the largest discounted return of the data, in
            absolute value, so that values lie in -1 .. 1.
        target_rate: How far the target network moves towards the network at each step, in 0 .. 1.
    """

    discount: float = 0.99
    reward_scale: float | None = 1.0
    target_rate: float = 0.005

    def __post_init__(self) -> None:
        check_types(self)
        check_within(self, 0, 1, "discount", "target_rate")
        if self.reward_scale is not None and self.reward_scale <= 0:
            raise ValueError(
                f"reward_scale must be positive, got {self.reward_scale}: it divides rewards"
            )


def lacks_scale(settings: Any) -> bool:
    """Returns whether a method with these settings takes its scale of rewards from the data."""
    return isinstance(settings, ValueSettings) and settings.reward_scale is None


def measure_scale(discount: float, demonstrations: Sequence[Demonstration]) -> float:
    """Returns the largest absolute discounted return from any step of the data; 1 without rewards.

    Args:
        discount: discount of rewards per step, in 0 .. 1.
        demonstrations: training data.
    """
    largest = 0.0
    for demonstration in demonstrations:
        value = 0.0
        for reward in np.asarray(demonstration.rewards, np.float64)[::-1]:
            value = reward + discount * value
            largest = max(largest, abs(value))
    return largest or 1.0
