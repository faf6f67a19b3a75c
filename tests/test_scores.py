import inspect
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from experiments import report
from experiments.tables.cells import collect_outcomes
from leapjax import scores
from leapjax.scores import (
    aggregate,
    interquartile_mean,
    interval_of_episodes,
    interval_over_seeds,
    variance_components,
    wilson_interval,
)
from tests.programs import LONG, ROOT

counts = st.integers(1, 100_000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@given(counts, st.floats(0.1, 4.0))
def test_wilson_bounds_satisfy_their_definition(case, z):
    usual = wilson_interval(*case, stats.norm.ppf(0.975))
    assert wilson_interval(*case) == pytest.approx(usual, abs=1e-6)
    successes, episodes = case
    rate = successes / episodes
    low, high = wilson_interval(successes, episodes, z)
    assert 0 <= low <= rate <= high <= 1 and low < high
    for bound in wilson_interval(successes, episodes, z):
        # The score test just accepts a bound: the rate is z standard deviations from it.
        distance = abs(rate - bound)
        assert distance == pytest.approx(z * math.sqrt(bound * (1 - bound) / episodes), abs=1e-7)


def test_differing_seeds_widen_the_interval():
    def measure_width(*successes, **correlation):
        low, high = interval_over_seeds(successes, [500] * len(successes), **correlation)
        return high - low

    for correlation in (0, 0.6, 1):
        equal = measure_width(450, 450, 450, correlation=correlation)
        # Three seeds on the same levels are worth fewer episodes than on separate levels.
        count = 3 * 500 / (1 + 2 * correlation)
        low, high = wilson_interval(round(0.9 * count), round(count))
        assert equal == pytest.approx(high - low, rel=0.05)
        assert measure_width(400, 450, 500, correlation=correlation) > 3 * equal


def test_intervals_at_the_extremes_follow_jeffreys_prior():
    for seeds in (1, 3):
        low, high = interval_of_episodes(np.ones((seeds, 200), bool))
        assert low == pytest.approx(stats.beta.ppf(0.025, 200.5, 0.5), abs=1e-3) and high == 1
    assert interval_of_episodes(np.zeros((3, 200), bool))[0] == 0


def test_variance_components_match_the_simulated_outcomes():
    rng = np.random.default_rng(0)
    seeds, levels, _ = variance_components(draw_outcomes(rng, 400, 2000, 0.7, 0, deviation=0.1))
    assert seeds == pytest.approx(0.01, rel=0.2) and levels == pytest.approx(0, abs=1e-4)
    seeds, levels, rest = variance_components(draw_outcomes(rng, 100, 8000, 0.7, 0.6))
    assert seeds == pytest.approx(0, abs=1e-4) and levels + rest == pytest.approx(0.21, rel=0.02)
    assert levels / (levels + rest) == pytest.approx(0.6, rel=0.05)


def draw_outcomes(rng, seeds, levels, rate, correlation, deviation=0.0):
    """Draws outcomes [S, L]: rates of seeds deviate, and outcomes of a level correlate."""
    common, own = rng.random(levels), rng.random((seeds, levels))
    shared = rng.random((seeds, levels)) < math.sqrt(correlation)
    return np.where(shared, common, own) < rng.normal(rate, deviation, (seeds, 1))


@pytest.mark.parametrize("correlation", [0, 0.6])
@pytest.mark.parametrize("rate", [0.5, 0.95])
@pytest.mark.parametrize("seeds", [1, 3, 5])
def test_intervals_have_their_nominal_coverage(seeds, rate, correlation, monkeypatch):
    monkeypatch.setattr(scores, "BOOTSTRAPS", 4000)
    rng = np.random.default_rng(0)
    covered, count = np.zeros(2), 4000 if LONG else 400
    for _ in range(count):
        solved = draw_outcomes(rng, seeds, 200, rate, correlation)
        counts = solved.sum(axis=1), [200] * seeds
        found = interval_of_episodes(solved), interval_over_seeds(*counts, 0.95, correlation)
        covered += [low <= rate <= high for low, high in found]
    assert (0.92 * count <= covered).all() and (covered <= 0.98 * count).all()


def test_default_correlation_matches_the_recorded_episodes():
    """Pools the settings of BabyAI that have several seeds."""
    rows = report.read_rows(ROOT, "babyai")
    by_setting = {}
    for row in rows:
        setting = {**row["configuration"], "seed": None}
        by_setting.setdefault(json.dumps(setting, sort_keys=True), []).append(row)
    found = [collect_outcomes(group) for group in by_setting.values() if len(group) > 1]
    matrices = [each for each in found if isinstance(each, np.ndarray)]
    assert len(matrices) > 50
    _, levels, rest = np.sum([variance_components(each) for each in matrices], axis=0)
    default = inspect.signature(interval_over_seeds).parameters["correlation"].default
    assert levels / (levels + rest) == pytest.approx(default, abs=0.05)


WRONG = [(2, 1), (-1, 5), (0, 0), (2.0, 5), (True, 5), ("2", 5), (1, None), (1, math.nan)]
SEEDS = [([], []), ([5], [10, 20]), (5, [10]), ("5", "9"), *(([s], [e]) for s, e in WRONG)]


@pytest.mark.parametrize(
    ("call", "wrong", "message"),
    [
        (lambda x: wilson_interval(*x), WRONG, "(successes|episodes) must be"),
        (lambda x: wilson_interval(1, 2, x), [-1.0, math.nan, "2"], "z must be"),
        (lambda x: interval_over_seeds(*x), SEEDS, "successes|episodes"),
        (lambda x: aggregate([([1], [2]), x]), SEEDS, "successes|episodes"),
        (lambda x: interval_over_seeds([1], [2], x), [0, 1, 95, math.nan, "0.9"], "level must be"),
        (lambda x: interval_over_seeds([1], [2], correlation=x), [-0.1, 1.1], "correlation must"),
        (interval_of_episodes, [np.ones(3, bool), np.ones((2, 3)), 1], "outcomes must be an array"),
        (aggregate, [[]], "no tasks"),
    ],
)
def test_invalid_counts_and_levels_raise_an_error(call, wrong, message):
    for each in wrong:
        with pytest.raises(ValueError, match=message):
            call(each)


def test_interquartile_mean_equals_scipys_trimmed_mean():
    rng = np.random.default_rng(0)
    for count in (1, 3, 4, 7, 20):
        values = rng.normal(size=(5, count))
        expected = stats.trim_mean(values, 0.25, axis=1)  # as in rliable
        np.testing.assert_allclose(interquartile_mean(values), expected)


def test_aggregates_are_stratified_by_level():
    levels = [([50, 60], [100, 100]), ([90], [100]), ([0], [100]), ([80], [100])]
    middle, (low, high) = aggregate(levels)
    assert middle == pytest.approx((0.55 + 0.8) / 2)  # the best and the worst do not count
    assert low < middle < high
    # With many episodes only the seeds of the first level differ.
    certain = [tuple([n * 10**7 for n in part] for part in level) for level in levels]
    low, high = interval_over_seeds(*certain[0])
    assert aggregate(certain)[1] == pytest.approx(((low + 0.8) / 2, (0.9 + 0.8) / 2), abs=0.01)
    assert aggregate([([190], [200])]) == (0.95, interval_over_seeds([190], [200]))
    solved = np.arange(200)[None] < 190
    assert aggregate([solved]) == (0.95, interval_of_episodes(solved))
