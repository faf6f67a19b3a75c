import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from leapjax.scores import wilson_interval

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


@pytest.mark.parametrize(("successes", "episodes"), [(0, 0), (1, 0), (-1, 5), (6, 5), (0, -1)])
def test_impossible_counts_are_refused(successes, episodes):
    with pytest.raises(ValueError, match=f"{successes} successes of {episodes} episodes"):
        wilson_interval(successes, episodes)
