"""Scales rewards, because one learning rate suits values of one size."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from leapjax.types import Demonstration


def check_reward_scale(scale: float | None) -> None:
    """Checks a divisor of rewards.

    Raises:
        ValueError: it is not positive.
    """
    if scale is not None and scale <= 0:
        raise ValueError(f"reward_scale must be positive, got {scale}: it divides rewards")


def lacks_scale(settings: Any) -> bool:
    """Returns whether a method with these settings takes its scale of rewards from the data."""
    return getattr(settings, "reward_scale", 1.0) is None


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
