"""Scores with their uncertainty."""

import math
from collections.abc import Sequence

import numpy as np

from leapjax.checks import check_counts, check_integer, check_number

BOOTSTRAPS = 20_000
# The correlation of success between training seeds that play the same levels: 0.2 to 0.67 in the
# rows of BabyAI. The largest is the careful choice.
SHARED = 0.67


def wilson_interval(successes: int, episodes: int, z: float = 1.959964) -> tuple[float, float]:
    """The 95% confidence interval of a success rate (Wilson, 1927), as fractions.

    Unlike the normal approximation it stays inside 0 .. 1 and is sound at 0% and 100%.

    Args:
        successes: of the episodes.
        episodes: how many.
        z: standard errors to each side; 1.96 for 95%.

    Raises:
        ValueError: counts that are not integers, no episodes, more successes than episodes, or a
            `z` that is negative or not finite.
    """
    episodes = check_integer("episodes", episodes, 1)
    successes = check_integer("successes", successes, 0, episodes)
    z = check_number("z", z, 0)
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

    A bootstrap that draws seeds, then levels: it contains the spread of both. All seeds play the
    same levels, of which some are hard for all (`SHARED`), and more seeds say no more about those.
    Rates are drawn as those that so many levels make likely (Beta, Jeffreys' prior), so that a
    planner without failures is not taken for one that cannot fail. Of one seed only the spread
    between levels is known.

    Args:
        successes: `[S]` of each training seed.
        episodes: `[S]` of each training seed, one on each level.
        level: of confidence, between 0 and 1.

    Raises:
        ValueError: counts that are not integers, or not of the same seeds; no seeds, no episodes,
            or more successes than episodes; or a level out of range.
    """
    good, count = _check_outcomes(successes, episodes)
    means = _drawn_means(good, count, np.random.default_rng(0))
    rate = float((good / count).mean())
    return _bounds(means, rate, level)


def standard_error(values: np.ndarray) -> float | None:
    """Of the mean of values `[n]`; None for fewer than two, which say nothing of it."""
    if len(values) < 2:
        return None
    return float(np.std(values, ddof=1) / math.sqrt(len(values)))


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """The mean of the middle half of values `[..., L]` (Agarwal et al., 2021): `[...]`.

    As scipy's `trim_mean` and rliable have it: a quarter of the values, rounded down, is left out
    at each end.
    """
    cut = values.shape[-1] // 4
    return np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut].mean(axis=-1)


def aggregate(
    levels: Sequence[tuple[Sequence[int], Sequence[int]]], level: float = 0.95
) -> tuple[float, tuple[float, float]]:
    """The interquartile mean of success over levels, and its confidence interval, as fractions.

    A bootstrap stratified by level (Agarwal et al., 2021, arXiv 2108.13264): within each of L
    levels seeds are drawn, then episodes, as `interval_over_seeds` does. A level counts by the mean
    of its seeds, of which some levels have more than others. A quarter of the levels, rounded
    down, is left out at each end.

    Args:
        levels: L pairs, (successes `[S]`, episodes `[S]`) of the S training seeds of each level; S
            may differ.
        level: of confidence, between 0 and 1.

    Returns:
        The mean, and (low, high).

    Raises:
        ValueError: no levels; and as of `interval_over_seeds`.
    """
    if not levels:
        raise ValueError("no levels to aggregate over")
    rng = np.random.default_rng(0)
    outcomes = [_check_outcomes(*each) for each in levels]
    drawn = np.stack([_drawn_means(good, count, rng) for good, count in outcomes], axis=-1)
    rates = np.array([(good / count).mean() for good, count in outcomes])
    middle = float(interquartile_mean(rates))
    return middle, _bounds(interquartile_mean(drawn), middle, level)


def _check_outcomes(
    successes: Sequence[int], episodes: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Successes and episodes `[S]`, of the same seeds.

    Raises:
        ValueError: says what is wrong with them.
    """
    good, count = check_counts("successes", successes), check_counts("episodes", episodes, 1)
    if not len(good) or len(good) != len(count) or (good > count).any():
        raise ValueError(f"{good.tolist()} successes of {count.tolist()} episodes")
    return good, count


def _drawn_means(good: np.ndarray, count: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mean success rates `[BOOTSTRAPS]` of seeds, and levels, that could as well have been."""
    rates, seeds = good / count, len(good)
    chosen = rng.integers(0, seeds, (BOOTSTRAPS, seeds))
    # The mean of a draw of S of S values varies (S - 1) / S as much as that of S others.
    wider = math.sqrt(seeds / max(seeds - 1, 1))
    means = np.clip(rates.mean() + wider * (rates[chosen].mean(axis=1) - rates.mean()), 0, 1)
    # How rates of seeds differ holds what each of them did by chance; what they share is missing.
    levels = count.min() / (SHARED if seeds > 1 else 1)
    return rng.beta(levels * means + 0.5, levels * (1 - means) + 0.5)


def _bounds(drawn: np.ndarray, found: float, level: float) -> tuple[float, float]:
    """The interval of a bootstrap, which holds what was found."""
    if not 0 < check_number("level", level) < 1:
        raise ValueError(f"level must be between 0 and 1, got {level}")
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return min(found, float(low)), max(found, float(high))
