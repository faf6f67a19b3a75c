import math

import numpy as np
import pytest

from leapjax import checks
from leapjax.errors import UserError


@pytest.mark.parametrize("value", [5, np.int8(5), np.uint64(5), np.array(5)])
def test_an_integer_of_any_type_is_that_integer(value):
    found = checks.check_integer("count", value)
    assert found == 5
    assert type(found) is int


@pytest.mark.parametrize("value", [5.0, "5", None, True, np.True_, np.float32(5), [5], 5 + 0j])
def test_what_is_no_integer_is_refused(value):
    with pytest.raises(UserError, match="count must be an integer"):
        checks.check_integer("count", value)


def test_integers_out_of_range_are_refused():
    with pytest.raises(UserError, match="at least 1, got 0"):
        checks.check_integer("count", 0, 1)
    with pytest.raises(UserError, match=r"at most 2147483647, got 9{57}\.\.\."):
        checks.check_integer("count", 10**100 - 1)


@pytest.mark.parametrize("value", [math.nan, math.inf, "1", None, True, 1j, [1.0, 2.0], 10**400])
def test_what_is_no_finite_number_is_refused(value):
    with pytest.raises(UserError, match="weight must be"):
        checks.check_number("weight", value)


def test_numbers_fit_another_type_or_are_refused():
    assert checks.check_fits("it", [1.0, -2.0], np.dtype(np.int8)).tolist() == [1, -2]
    assert checks.check_fits("it", np.uint64(2**31 - 1), np.dtype(np.int32)) == 2**31 - 1
    assert checks.check_fits("it", np.array([0, 1]), np.dtype(bool)).tolist() == [False, True]
    for value, kind in [
        (2**32 + 2, np.int32), (2**31, np.int32), (np.uint64(2**64 - 5), np.int32), (-1, np.uint8),
        (0.5, np.int32), (math.nan, np.int32), (2, bool), (1e39, np.float32),
        (-math.inf, np.float32), (math.nan, np.float32),
    ]:  # fmt: skip
        with pytest.raises(UserError, match="it: numbers that do not fit"):
            checks.check_fits("it", [0, value], np.dtype(kind))
    for value in ("1", None, 1j):
        with pytest.raises(UserError, match="it: numbers expected"):
            checks.check_fits("it", value, np.dtype(np.float32))


def test_a_seed_is_one_of_those_that_jax_tells_apart():
    assert checks.check_seed(2**32 - 1) == 2**32 - 1
    for wrong in (-1, 2**32, 2**64, 5.0, True):
        with pytest.raises(UserError, match="seed must be"):
            checks.check_seed(wrong)


@pytest.mark.parametrize("values", [range(3), np.arange(3), np.arange(3, dtype=np.uint32)])
def test_seeds_of_any_sequence_are_the_same_array(values):
    found = checks.check_seeds(values)
    assert found.dtype == np.uint32
    assert found.tolist() == [0, 1, 2]


@pytest.mark.parametrize("values", [[2**32], np.array([-1]), [0.0], 5, np.zeros((2, 2), np.uint32)])
def test_wrong_seeds_are_refused(values):
    with pytest.raises(UserError, match="seed"):
        checks.check_seeds(values)


def test_indices_are_integers_or_a_mask_of_the_right_length():
    assert checks.check_indices("actions", [2, np.int64(0)], 3) == (0, 2)
    assert checks.check_indices("actions", np.array([False, False, True]), 3) == (2,)
    assert checks.check_indices("actions", [], 3) == ()
    for wrong in ([1.5], [3], [-1], [True, False], [0, True, 1], [1, 1], ["1"]):
        with pytest.raises(UserError, match="actions"):
            checks.check_indices("actions", wrong, 3)
