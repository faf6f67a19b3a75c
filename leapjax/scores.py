"""Scores with their uncertainty."""

import math


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
