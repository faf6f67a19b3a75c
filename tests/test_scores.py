import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from leapjax.scores import (
    SHARED,
    aggregate,
    interquartile_mean,
    interval_over_seeds,
    wilson_interval,
)

counts = st.integers(1, 100_000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@pytest.mark.parametrize(
    ("successes", "episodes", "low", "high"),
    [
        (0, 10, 0.0, 0.2775),
        (10, 10, 0.7225, 1.0),
        (5, 10, 0.2366, 0.7634),
        (190, 200, 0.9104, 0.9726),
        (1, 1, 0.2065, 1.0),
    ],
)
def test_known_intervals(successes, episodes, low, high):
    assert wilson_interval(successes, episodes) == pytest.approx((low, high), abs=1e-4)


@given(counts)
def test_interval_is_ordered_and_contains_the_rate(case):
    successes, episodes = case
    low, high = wilson_interval(successes, episodes)
    assert 0 <= low <= successes / episodes <= high <= 1
    assert low < high


@given(counts, st.floats(0.1, 4.0))
def test_bounds_are_the_rates_that_the_score_test_just_accepts(case, z):
    successes, episodes = case
    rate = successes / episodes
    for bound in wilson_interval(successes, episodes, z):
        # The definition: the observed rate is z standard deviations from the bound.
        distance = abs(rate - bound)
        assert distance == pytest.approx(z * math.sqrt(bound * (1 - bound) / episodes), abs=1e-7)


@given(st.integers(1, 5000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_successes_and_failures_mirror_each_other(case):
    successes, episodes = case
    low, high = wilson_interval(successes, episodes)
    other_low, other_high = wilson_interval(episodes - successes, episodes)
    assert (1 - other_high, 1 - other_low) == pytest.approx((low, high), abs=1e-12)


def test_more_episodes_narrow_the_interval():
    widths = []
    for episodes in (10, 100, 1000):
        low, high = wilson_interval(episodes // 2, episodes)
        widths.append(high - low)
    assert widths == sorted(widths, reverse=True)
    assert widths[-1] == pytest.approx(widths[0] / 10, rel=0.2)


NO_COUNTS = [2.0, 2.5, True, "2", None, math.nan, [2]]


@pytest.mark.parametrize(
    ("successes", "episodes"),
    [(0, 0), (1, 0), (-1, 5), (6, 5), (0, -1), *((each, 5) for each in NO_COUNTS),
     *((1, each) for each in NO_COUNTS)],
)  # fmt: skip
def test_impossible_counts_are_refused(successes, episodes):
    with pytest.raises(ValueError, match="(successes|episodes) must be"):
        wilson_interval(successes, episodes)


@pytest.mark.parametrize("z", [-1.0, math.nan, math.inf, "2", None])
def test_impossible_standard_errors_are_refused(z):
    with pytest.raises(ValueError, match="z must be"):
        wilson_interval(1, 2, z)


def test_one_seed_has_the_interval_of_its_episodes():
    for successes in (0, 3, 100, 190, 200):
        expected = wilson_interval(successes, 200)
        assert interval_over_seeds([successes], [200]) == pytest.approx(expected, abs=0.01)
    low, high = interval_over_seeds([200, 200, 200], [200, 200, 200])
    assert 0.98 < low < high == 1.0


def test_seeds_that_differ_widen_the_interval():
    def width(*successes):
        low, high = interval_over_seeds(successes, [500] * len(successes))
        return high - low

    alike, apart = width(450, 450, 450), width(400, 450, 500)
    # They play the same levels: three seeds do not say as much as three times the levels would.
    low, high = wilson_interval(round(450 / SHARED), round(500 / SHARED))
    assert alike == pytest.approx(high - low, rel=0.05)
    assert apart > 3 * alike


def test_where_episodes_are_many_it_is_the_bootstrap_over_seeds():
    rates = np.array([0.2, 0.5, 0.9])
    low, high = interval_over_seeds((rates * 10**9).astype(int), [10**9] * 3)
    # Three of three seeds are the least, or the best, one time in 27: more often than 2.5%. From
    # their mean that is further by the root of 3 / 2, for which three seeds vary too little.
    mean = rates.mean()
    expected = mean + math.sqrt(3 / 2) * (rates[[0, 2]] - mean)
    assert (low, high) == pytest.approx(tuple(expected), abs=1e-3)


def test_the_interval_over_seeds_holds_the_truth_as_often_as_it_says():
    """Of seeds that differ, and fail on the same levels more often than chance has it."""
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(200):
        hard, alone = rng.normal(size=200), rng.normal(size=(3, 200))
        needed = stats.norm.ppf(np.clip(rng.normal(0.8, 0.02, 3), 0, 1))
        solved = np.sqrt(0.6) * hard + np.sqrt(0.4) * alone < needed[:, None]
        low, high = interval_over_seeds(solved.sum(axis=1), [200] * 3)
        held += low <= 0.8 <= high
    assert 185 <= held <= 199


@pytest.mark.parametrize(
    ("successes", "episodes"),
    [([], []), ([1], [0]), ([3, 6], [5, 5]), ([5], [10, 20]), ([5, 6], [10]), (5, [10]), ([5], 10),
     ([[5]], [[10]]), ([], [10]), (np.array([0.5]), [10]), (np.array([True]), [10]), ("5", "9"),
     *(([each], [5]) for each in NO_COUNTS), *(([1, 1], [5, each]) for each in NO_COUNTS)],
)  # fmt: skip
def test_impossible_seeds_are_refused(successes, episodes):
    for measure in (interval_over_seeds, lambda *outcome: aggregate([([1], [2]), outcome])):
        with pytest.raises(ValueError, match="successes|episodes"):
            measure(successes, episodes)


@pytest.mark.parametrize("level", [0, 1, -0.5, 95, math.nan, "0.9", None])
def test_impossible_levels_of_confidence_are_refused(level):
    with pytest.raises(ValueError, match="level must be"):
        interval_over_seeds([1], [2], level)
    with pytest.raises(ValueError, match="level must be"):
        aggregate([([1], [2])], level)


def test_the_interquartile_mean_is_scipys_and_rliables():
    rng = np.random.default_rng(0)
    for count in (1, 3, 4, 7, 20):
        values = rng.normal(size=(5, count))
        expected = stats.trim_mean(values, 0.25, axis=1)
        np.testing.assert_allclose(interquartile_mean(values), expected)


def test_an_aggregate_is_stratified_by_level():
    levels = [([50, 60], [100, 100]), ([90], [100]), ([0], [100]), ([80], [100])]
    middle, (low, high) = aggregate(levels)
    assert middle == pytest.approx((0.55 + 0.8) / 2)  # the best and the worst do not count
    assert low < middle < high
    # Of many episodes only the seeds of the first level are left to differ.
    certain = [([g * 10**7 for g in good], [c * 10**7 for c in of]) for good, of in levels]
    far = 0.05 * math.sqrt(2)
    expected = [(0.55 - far + 0.8) / 2, (0.55 + far + 0.8) / 2]
    assert aggregate(certain)[1] == pytest.approx(expected, abs=1e-3)
    one = aggregate([([190], [200])])
    assert one == (0.95, interval_over_seeds([190], [200]))
    with pytest.raises(ValueError, match="no levels"):
        aggregate([])
    with pytest.raises(ValueError, match="successes of"):
        aggregate([([1], [1]), ([2], [1])])
