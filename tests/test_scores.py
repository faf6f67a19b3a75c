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


@given(counts, st.floats(0.1, 4.0))
def test_bounds_are_the_rates_that_the_score_test_just_accepts(case, z):
    successes, episodes = case
    rate = successes / episodes
    low, high = wilson_interval(successes, episodes, z)
    assert 0 <= low <= rate <= high <= 1 and low < high
    for bound in wilson_interval(successes, episodes, z):
        # The definition: the observed rate is z standard deviations from the bound.
        distance = abs(rate - bound)
        assert distance == pytest.approx(z * math.sqrt(bound * (1 - bound) / episodes), abs=1e-7)


NO_COUNTS = [2.0, 2.5, True, "2", None, math.nan, [2]]


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


COUNTS = [(0, 0), (-1, 5), (6, 5), *((each, 5) for each in NO_COUNTS)]
SEEDS = [
    ([], []), ([1], [0]), ([3, 6], [5, 5]), ([5], [10, 20]), (5, [10]), ([[5]], [[10]]),
    (np.array([True]), [10]), ("5", "9"), *(([1, 1], [5, each]) for each in NO_COUNTS),
]  # fmt: skip


@pytest.mark.parametrize(
    ("call", "message"),
    [
        *((lambda c=c: wilson_interval(*c), "(successes|episodes) must be") for c in COUNTS),
        *((lambda z=z: wilson_interval(1, 2, z), "z must be") for z in (-1.0, math.nan, "2")),
        *((lambda s=s: interval_over_seeds(*s), "successes|episodes") for s in SEEDS),
        *((lambda s=s: aggregate([([1], [2]), s]), "successes|episodes") for s in SEEDS),
        *(
            (lambda x=level: interval_over_seeds([1], [2], x), "level must be")
            for level in (0, 1, 95, math.nan, "0.9")
        ),
        (lambda: aggregate([([1], [2])], None), "level must be"),
        (lambda: aggregate([]), "no levels"),
        (lambda: aggregate([([1], [1]), ([2], [1])]), "successes of"),
    ],
)
def test_impossible_counts_and_levels_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


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
