"""Scores with their uncertainty."""

import math
from collections.abc import Sequence

import numpy as np

from leapjax.checks import check_counts, check_integer, check_number

BOOTSTRAPS = 20_000
# Assumed correlation of success between two training seeds on the same level, if only counts are
# known. Measured in our recorded episodes: 0.3 to 0.6, depending on the task.
CORRELATION = 0.5
# Outcomes of one task: whether each of S training seeds solves each of L levels, `[S, L]` bool. If
# only counts are known: the successes `[S]` and the episodes `[S]` of each seed.
Outcomes = np.ndarray | tuple[Sequence[int], Sequence[int]]


def wilson_interval(successes: int, episodes: int, z: float = 1.959964) -> tuple[float, float]:
    """The 95% confidence interval of a success rate (Wilson, 1927), as fractions.

    Unlike the normal approximation it stays inside 0 .. 1 and is sound at 0% and 100%.

    Args:
        successes: number of successful episodes.
        episodes: number of episodes.
        z: standard errors to each side; 1.96 for 95%.

    Raises:
        ValueError: the counts are not integers, there are no episodes or more successes than
            episodes, or `z` is negative or not finite.
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
    successes: Sequence[int],
    episodes: Sequence[int],
    level: float = 0.95,
    correlation: float = CORRELATION,
) -> tuple[float, float]:
    """Estimates the mean success rate over training seeds from counts.

    Use `interval_of_episodes` where the outcome of every episode is known. The interval contains
    the spread of seeds and of levels. All seeds play the same levels, and some levels are hard for
    all seeds, so S seeds tell less than S times as many levels would. The rate has Jeffreys' prior,
    so a planner without failures in these episodes may still fail in others. One seed shows only
    the spread of levels.

    Args:
        successes: `[S]`, number of successes of each training seed.
        episodes: `[S]`, number of episodes of each training seed, one per level.
        level: confidence, between 0 and 1.
        correlation: correlation of success between two seeds on the same level, 0 to 1.

    Returns:
        The bounds of the confidence interval, as fractions.

    Raises:
        ValueError: The counts are not integers, or not of the same seeds. There are no seeds, no
            episodes, or more successes than episodes. The level or the correlation is out of range.
    """
    correlation = check_number("correlation", correlation, 0, 1)
    rng = np.random.default_rng(0)
    return _bounds(*_draw_from_counts(successes, episodes, rng, correlation), level)


def interval_of_episodes(solved: np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Estimates the mean success rate over training seeds from episodes.

    Levels are drawn in a Bayesian bootstrap (Rubin, 1981) with Jeffreys' prior. All seeds share a
    drawn level, so they are as correlated as in the episodes. The mean of the seeds is drawn from
    Student's t distribution with S - 1 degrees of freedom. Its scale comes from the variance
    between seeds (analysis of variance), without the part that chance explains. Seeds drawn with
    replacement would vary too little: where seeds differ, the 95% interval of three seeds covers
    the truth in 84% of cases.

    Args:
        solved: `[S, L]` bool, whether each training seed solved each level.
        level: confidence, between 0 and 1.

    Returns:
        The bounds of the confidence interval, as fractions.

    Raises:
        ValueError: `solved` is not such a matrix, or the level is out of range.
    """
    return _bounds(*_draw_from_episodes(solved, np.random.default_rng(0)), level)


def standard_error(values: np.ndarray) -> float | None:
    """Estimates the standard error of the mean of values `[n]`; returns `None` if n < 2."""
    if len(values) < 2:
        return None
    return float(np.std(values, ddof=1) / math.sqrt(len(values)))


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Computes the mean of the middle half of values `[..., L]` (Agarwal et al., 2021): `[...]`.

    A quarter of the values, rounded down, is left out at each end, as in scipy's `trim_mean` and in
    rliable.
    """
    cut = values.shape[-1] // 4
    return np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut].mean(axis=-1)


def aggregate(tasks: Sequence[Outcomes], level: float = 0.95) -> tuple[float, tuple[float, float]]:
    """Estimates the interquartile mean of success over tasks.

    A quarter of the tasks, rounded down, is left out at each end. The bootstrap is stratified by
    task (Agarwal et al., 2021, arXiv 2108.13264): within each, seeds and levels are drawn as in
    `interval_of_episodes` or `interval_over_seeds`. A task counts once, however many seeds it has.

    Args:
        tasks: outcomes of each: `[S, L]` bool, or a pair (successes `[S]`, episodes `[S]`); S may
            differ.
        level: confidence, between 0 and 1.

    Returns:
        The interquartile mean, and its interval (low, high), as fractions.

    Raises:
        ValueError: there are no tasks; or see `interval_of_episodes` and `interval_over_seeds`.
    """
    if not tasks:
        raise ValueError("no tasks to aggregate over")
    rng = np.random.default_rng(0)
    found = [
        _draw_from_episodes(each, rng)
        if isinstance(each, np.ndarray)
        else _draw_from_counts(*each, rng)
        for each in tasks
    ]
    drawn = interquartile_mean(np.stack([means for means, _ in found], axis=-1))
    middle = float(interquartile_mean(np.array([rate for _, rate in found])))
    return middle, _bounds(drawn, middle, level)


def _check_outcomes(
    successes: Sequence[int], episodes: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Checks successes and episodes `[S]` of the same seeds, and returns them as arrays.

    Raises:
        ValueError: they are not such counts; the message shows them.
    """
    good, count = check_counts("successes", successes), check_counts("episodes", episodes, 1)
    if not len(good) or len(good) != len(count) or (good > count).any():
        raise ValueError(f"{good.tolist()} successes of {count.tolist()} episodes")
    return good, count


def variance_components(solved: np.ndarray) -> tuple[float, float, float]:
    """Splits the variance of success into three parts: seeds, levels, and the rest.

    It is a two-way analysis of variance without replication. The correlation of success between two
    seeds on the same level is the share of `levels` in `levels + rest`.

    Args:
        solved: `[S, L]` bool, S and L at least 2.

    Returns:
        `seeds`, `levels` and `rest`: unbiased estimates, so the first two may be negative.
    """
    seeds, levels = solved.mean(axis=1), solved.mean(axis=0)
    residuals = solved - seeds[:, None] - levels + solved.mean()
    rest = float((residuals**2).sum()) / ((len(seeds) - 1) * (len(levels) - 1))
    of_seeds = float(seeds.var(ddof=1)) - rest / len(levels)
    return of_seeds, float(levels.var(ddof=1)) - rest / len(seeds), rest


def _draw_from_episodes(solved: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Draws mean success rates `[BOOTSTRAPS]` given outcomes `[S, L]`; and their observed mean."""
    solved = np.asarray(solved)
    if solved.dtype != bool or solved.ndim != 2 or not solved.size:
        raise ValueError(
            f"outcomes must be an array [seeds, levels] of bool, got {solved.dtype} of shape "
            f"{solved.shape}"
        )
    seeds, count = solved.shape
    # Count the levels that 0, 1, .. S seeds solve. The prior adds half a level that no seed solves,
    # and half a level that all seeds solve. With one seed this is the Beta posterior of Jeffreys'
    # prior.
    alike = np.bincount(solved.sum(axis=0), minlength=seeds + 1).astype(float)
    alike[[0, -1]] += 0.5
    weights = rng.gamma(alike, size=(BOOTSTRAPS, seeds + 1))
    means = weights @ np.linspace(0, 1, seeds + 1) / weights.sum(axis=1)
    between = variance_components(solved)[0] if min(seeds, count) > 1 else 0.0
    return _vary_seeds(means, between, seeds, rng), float(solved.mean())


def _draw_from_counts(
    successes: Sequence[int],
    episodes: Sequence[int],
    rng: np.random.Generator,
    correlation: float = CORRELATION,
) -> tuple[np.ndarray, float]:
    """Draws mean success rates `[BOOTSTRAPS]` given counts `[S]`; and their observed mean."""
    good, count = _check_outcomes(successes, episodes)
    rates, seeds, levels = good / count, len(good), count.min()
    mean = float(rates.mean())
    independent = levels * seeds / (1 + (seeds - 1) * correlation)  # effective number of episodes
    means = rng.beta(independent * mean + 0.5, independent * (1 - mean) + 0.5, BOOTSTRAPS)
    chance = mean * (1 - mean) * (1 - correlation) / levels
    between = float(rates.var(ddof=1)) - chance if seeds > 1 else 0.0
    return _vary_seeds(means, between, seeds, rng), mean


def _vary_seeds(
    means: np.ndarray, between: float, seeds: int, rng: np.random.Generator
) -> np.ndarray:
    """Adds the error of a mean over few seeds to means `[N]`, given the variance between seeds."""
    if between <= 0:
        return means
    scale = math.sqrt(between / seeds)
    return np.clip(means + scale * rng.standard_t(seeds - 1, len(means)), 0, 1)


def _bounds(drawn: np.ndarray, found: float, level: float) -> tuple[float, float]:
    """Returns the interval of drawn values, extended to contain the value found."""
    if not 0 < check_number("level", level) < 1:
        raise ValueError(f"level must be between 0 and 1, got {level}")
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return min(found, float(low)), max(found, float(high))
