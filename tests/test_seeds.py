import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from leapjax.data import seeds
from leapjax.errors import UserError

TESTS = seeds.VALIDATION_START  # number of test levels
VALIDATIONS = seeds.TRAINING_START - seeds.VALIDATION_START
training = st.integers(0, seeds.MAX_TRAINING_SEED - 1)
counts = st.integers(1, 5000)
demonstrated_seeds = st.integers(0, 60) | st.integers(-1, 2**64 - 1)


def training_range(seed: int) -> range:
    """Returns the range of `training_seeds` from its first seed; checks that it counts up."""
    first, *more = itertools.islice(seeds.training_seeds(seed), 5)
    assert more == [*range(first + 1, first + 5)]
    return range(first, first + seeds.TRAINING_STRIDE)


def overlap(a: range, b: range) -> bool:
    return max(a.start, b.start) < min(a.stop, b.stop)


@given(st.integers(0, TESTS - 5000), st.integers(0, VALIDATIONS - 5000), counts, training, training)
def test_seeds_of_all_purposes_are_disjoint(test_first, validation_first, count, one, other):
    test = seeds.test_seeds(test_first, count)
    assert [*test[:2]] == [test_first, test_first + 1][:count]
    ranges = [test, seeds.validation_seeds(validation_first, count), training_range(one)]
    ranges += [training_range(other)] if one != other else []
    assert len(ranges[0]) == len(ranges[1]) == count
    assert not any(overlap(*pair) for pair in itertools.combinations(ranges, 2))


def test_ranges_of_consecutive_training_seeds_are_adjacent():
    every = seeds.training_seeds(3)
    assert len(list(itertools.islice(every, seeds.TRAINING_STRIDE))) == seeds.TRAINING_STRIDE
    with pytest.raises(UserError, match="no more level seeds"):
        next(every)
    assert training_range(3).stop == training_range(4).start
    # The largest seed fits 32-bit integers of NumPy and JAX.
    assert training_range(seeds.MAX_TRAINING_SEED - 1).stop < 2**31


@pytest.mark.parametrize(
    ("make", "limit"), [(seeds.test_seeds, TESTS), (seeds.validation_seeds, VALIDATIONS)]
)
def test_seeds_outside_their_range_raise_an_error(make, limit):
    assert len(make(limit - 10, 10)) == 10
    for first, count, message in [
        (limit - 10, 11, "leave their range"), (0, limit + 1, "leave their range"),
        (limit, 1, r"the first \w+ seed must be"), (-1, 1, r"the first \w+ seed must be"),
        (0.0, 1, r"the first \w+ seed must be"), (0, 0, r"the number of \w+ episodes must be"),
    ]:  # fmt: skip
        with pytest.raises(UserError, match=message):
            make(first, count)
    for seed in (-1, seeds.MAX_TRAINING_SEED, 1.0, True):
        with pytest.raises(UserError, match="training seed"):
            seeds.training_seeds(seed)


@given(st.lists(demonstrated_seeds, max_size=8), st.integers(0, 40), st.integers(1, 20))
def test_check_disjoint_rejects_exactly_the_shared_seeds(demonstrated, first, count):
    episodes = range(first, first + count)
    shared = set(demonstrated) & set(episodes)
    if shared:
        with pytest.raises(UserError) as raised:
            seeds.check_disjoint(demonstrated, episodes)
        assert any(f"level seed {seed} is both" in str(raised.value) for seed in shared)
    else:
        seeds.check_disjoint(demonstrated, episodes)
