"""Scores with their uncertainty."""

import math
from collections.abc import Sequence

import numpy as np

BOOTSTRAPS = 20_000


def wilson_interval(successes: int, episodes: int, z: float = 1.959964) -> tuple[float, float]:
    """The 95% confidence interval of a success rate (Wilson, 1927), as fractions.

    Unlike the normal approximation it stays inside 0 .. 1 and is sound at 0% and 100%.

    Raises:
        ValueError: no episodes, or more successes than episodes.
    """
    if episodes < 1 or not 0 <= successes <= episodes:
        raise ValueError(f"{successes} successes of {episodes} episodes")
    rate = successes / episodes
    scale = 1 + z**2 / episodes
    centre = (rate + z**2 / (2 * episodes)) / scale
    spread = z / scale * math.sqrt(rate * (1 - rate) / episodes + z**2 / (4 * episodes**2))
    # At 0% and 100% the bound is exact; rounding must not push it past the rate.
    return max(0.0, min(rate, centre - spread)), min(1.0, max(rate, centre + spread))


def interval_over_seeds(
    successes: Sequence[int], episodes: Sequence[int], level: float = 0.95
) -> tuple[float, float]:
    """The confidence interval of the mean success rate over training seeds, as fractions.

    A bootstrap that draws seeds, then episodes within each: it contains the spread of both.
    Episodes are drawn by rates that the seed's own episodes make likely (Beta, Jeffreys' prior),
    so that a seed without failures is not taken for one that cannot fail. Of one seed only the
    spread between episodes is known.

    Args:
        successes: `[S]` of each training seed.
        episodes: `[S]` of each training seed.
        level: of confidence.

    Raises:
        ValueError: no seeds, no episodes, or more successes than episodes.
    """
    good, count = np.asarray(successes), np.asarray(episodes)
    if not len(good) or (count < 1).any() or (good < 0).any() or (good > count).any():
        raise ValueError(f"{list(successes)} successes of {list(episodes)} episodes")
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(good), (BOOTSTRAPS, len(good)))
    rates = rng.beta(good[chosen] + 0.5, (count - good)[chosen] + 0.5)
    means = rates.mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    rate = float((good / count).mean())
    return min(rate, float(low)), max(rate, float(high))
