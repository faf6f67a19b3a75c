"""The values that rewards allow, to notice values that have diverged."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leapjax.agents.rewards import ValueSettings
from leapjax.types import Demonstration

TOLERANCE = 0.1  # of the width of the range: a network errs a little


def judge_values(
    settings: Any, demonstrations: Sequence[Demonstration], means: Mapping[str, float]
) -> str | None:
    """Returns a warning if a method has learned values that rewards do not allow, else `None`.

    Args:
        settings: settings of the method.
        demonstrations: training data.
        means: the last mean metrics of training, of which "value" is the mean value.
    """
    if not isinstance(settings, ValueSettings) or "value" not in means or not demonstrations:
        return None
    assert settings.reward_scale is not None  # the data have given it
    limits = find_value_range(settings.discount, demonstrations)
    low, high = (limit / settings.reward_scale for limit in limits)
    slack = TOLERANCE * (high - low)
    if low - slack <= means["value"] <= high + slack:
        return None
    return (
        f"the mean value of the data's states is {means['value']:.3g}, but rewards allow {low:.3g} "
        f"to {high:.3g}: values say nothing about returns here. Train longer, with a lower "
        "learning rate, or with a lower expectile (IQL) or alpha (CQL)"
    )


def find_value_range(
    discount: float, demonstrations: Sequence[Demonstration]
) -> tuple[float, float]:
    """Returns the lowest and the highest discounted return of any episode with rewards as here.

    Such an episode takes steps that do not end it, and then perhaps one that does; each has a
    reward that the data have for such a step. Of these episodes the best repeats the best step for
    ever, or ends at once. The range includes 0, where values begin.

    Args:
        discount: discount of rewards per step, in 0 .. 1.
        demonstrations: at least one.
    """
    steps = math.inf if discount == 1 else 1 / (1 - discount)  # discounted length without an end
    going_on = [d.rewards[:-1] if d.terminated else d.rewards for d in demonstrations]
    repeated = np.unique(np.concatenate(going_on)).astype(float)
    ending = np.array([d.rewards[-1] for d in demonstrations if d.terminated], float)
    for_ever = [reward * steps if reward else 0.0 for reward in repeated]
    returns = [0.0, *for_ever, *ending]
    return float(min(returns)), float(max(returns))
