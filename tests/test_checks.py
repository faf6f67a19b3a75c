import dataclasses
import json
import math
from pathlib import Path

import jax.numpy as jnp
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


@dataclasses.dataclass(frozen=True)
class Example:
    """A configuration with a field of every type."""

    count: int = 1
    share: float = 0.5
    known: bool = True
    name: str = "a"
    pair: tuple[float, float] = (0.5, 1.0)
    many: tuple[int, ...] = ()
    maybe: int | None = None
    limit: float = 1.0
    path: Path = Path()

    def __post_init__(self) -> None:
        checks.check_types(self, "limit")


WRONG = {
    "count": [1.0, True, "1", None, 2**31, -(2**32), [1]],
    "share": [math.nan, math.inf, -math.inf, "1", None, True, 1e39, [0.5]],
    "known": [1, "yes", None, 0.0],
    "name": [1, None, b"a"],
    "pair": [(0.5,), (0.5, math.nan), 0.5, None, "ab", (0.5, 1.0, 2.0)],
    "many": [(1.0,), (True,), 1, "1", None],
    "maybe": [1.0, "1", False],
    "limit": [math.nan, -math.inf, "1"],
}


@pytest.mark.parametrize(
    ("field", "value"), [(f, v) for f, values in WRONG.items() for v in values]
)
def test_a_field_holds_what_its_type_says(field, value):
    with pytest.raises(UserError, match=f"^{field} must be"):
        Example(**{field: value})


def test_a_configuration_holds_plain_values():
    given = Example(
        np.int64(3), np.float32(0.5), np.True_, np.str_("b"), [1, np.float64(2)], np.arange(2),
        jnp.int32(4), math.inf,
    )  # fmt: skip
    assert given == Example(3, 0.5, True, "b", (1, 2.0), (0, 1), 4, math.inf)
    assert (
        json.loads(json.dumps(dataclasses.asdict(dataclasses.replace(given, path="")))) is not None
    )
    assert isinstance(hash(given), int)
    # An integer that stands for a number is written as one: names are made of what is written.
    assert type(Example(share=1).share) is int


@pytest.mark.parametrize("values", [[1.0], [True], ["1"], [-1], [None], 1, "1", np.ones(2), None])
def test_counts_are_integers(values):
    with pytest.raises(UserError, match="counts must be"):
        checks.check_counts("counts", values)


@pytest.mark.parametrize("values", [(0, 2), np.array([0, 2], np.uint8), jnp.array([0, 2])])
def test_counts_of_any_sequence_are_the_same_array(values):
    found = checks.check_counts("counts", values)
    assert found.dtype == np.int64
    assert found.tolist() == [0, 2]


@pytest.mark.parametrize("value", [True, np.True_, 1, 1.0, np.array([1]), jnp.array(True)])
def test_a_flag_is_a_boolean_of_any_type(value):
    assert checks.check_flag("over", value) is True


@pytest.mark.parametrize("value", ["no", None, math.nan, 2, [True, False], [], {}])
def test_what_is_no_flag_is_refused(value):
    with pytest.raises(UserError, match="over must be true or false"):
        checks.check_flag("over", value)


@pytest.mark.parametrize(
    "values", [[[1, 2], [3]], np.array(["a"]), np.array([1, None]), np.array([1.5]), {"a": 1}]
)
def test_what_is_no_sequence_of_seeds_is_refused(values):
    with pytest.raises(UserError, match="seed"):
        checks.check_seeds(values)


def test_a_mapping_is_no_sequence():
    for check in (checks.check_counts, checks.check_numbers):
        with pytest.raises(UserError, match="weights must be a sequence"):
            check("weights", {1: 2})
