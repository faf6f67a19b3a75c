"""Fills in the settings of a method that the user leaves to the data."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from leapjax.agents.returns import choose_target, lacks_return_scale, lacks_target
from leapjax.agents.rewards import lacks_scale, measure_scale
from leapjax.types import Demonstration

MEASURED = ("target_return", "return_scale", "reward_scale")  # `None` leaves them to the data


def needs_data(settings: Any) -> bool:
    """Returns whether a method with these settings takes some of them from the data."""
    return lacks_target(settings) or lacks_return_scale(settings) or lacks_scale(settings)


def measure_settings(settings: Any, demonstrations: Sequence[Demonstration]) -> Any:
    """Returns settings of a method with a target return and scales from the data.

    Args:
        settings: settings of a method; values that they give stay.
        demonstrations: training data; without data the settings stay as they are.
    """
    found: dict[str, float] = {}
    if demonstrations and lacks_target(settings):
        found["target_return"] = choose_target(demonstrations)
    if demonstrations and lacks_return_scale(settings):
        found["return_scale"] = measure_scale(1.0, demonstrations)
    if demonstrations and lacks_scale(settings):
        found["reward_scale"] = measure_scale(settings.discount, demonstrations)
    return dataclasses.replace(settings, **found)
