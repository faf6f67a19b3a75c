import dataclasses
import functools
import math

import jax.numpy as jnp
import numpy as np
import pytest

from leapjax import checks
from leapjax.errors import UserError


@pytest.mark.parametrize(
    ("check", "values", "expected"),
    [
        (functools.partial(checks.check_integer, "count"), [5, np.int8(5), np.array(5)], 5),
        (checks.check_seed, [2**32 - 1], 2**32 - 1),
        (functools.partial(checks.check_flag, "over"), [True, np.True_, 1, jnp.array(True)], True),
        (checks.check_seeds, [range(3), np.arange(3)], np.arange(3, dtype=np.uint32)),
        (
            functools.partial(checks.check_counts, "n"),
            [(0, 2), jnp.array([0, 2])],
            np.array([0, 2]),
        ),
    ],
)
def test_checks_convert_values_to_python_or_numpy_types(check, values, expected):
    for value in values:
        found = check(value)
        assert type(found) is type(expected)
        np.testing.assert_array_equal(found, expected, strict=isinstance(found, np.ndarray))


@pytest.mark.parametrize(
    ("check", "values", "message"),
    [
        (checks.check_integer, [5.0, "5", None, True, np.True_, [5]], "it must be an integer"),
        (checks.check_integer, [10**100 - 1], r"at most 2147483647, got 9{57}\.\.\."),
        (functools.partial(checks.check_integer, least=1), [0], "at least 1, got 0"),
        (checks.check_number, [math.nan, math.inf, "1", None, True, 1j, 10**400], "it must be"),
        (checks.check_flag, ["no", None, math.nan, 2, [True, False]], "it must be true or false"),
        (checks.check_counts, [[1.0], [True], ["1"], [-1], 1, None, {1: 2}], "it must be"),
        (checks.check_numbers, [{1: 2}], "it must be a sequence"),
        (lambda _, x: checks.check_seed(x), [-1, 2**32, 5.0, True], "seed must be"),
        (lambda _, x: checks.check_seeds(x), [[2**32], [0.0], 5, np.array(["a"]), {}], "seed"),
    ],
)
def test_invalid_values_raise_an_error(check, values, message):
    for value in values:
        with pytest.raises(UserError, match=message):
            check("it", value)


def test_numbers_that_do_not_fit_a_type_raise_an_error():
    assert checks.check_fits("it", [1.0, -2.0], np.dtype(np.int8)).tolist() == [1, -2]
    assert checks.check_fits("it", np.uint64(2**31 - 1), np.dtype(np.int32)) == 2**31 - 1
    assert checks.check_fits("it", np.array([0, 1]), np.dtype(bool)).tolist() == [False, True]
    for value, kind in [
        (2**31, np.int32), (np.uint64(2**64 - 5), np.int32), (-1, np.uint8), (0.5, np.int32),
        (math.nan, np.int32), (2, bool), (1e39, np.float32), (math.nan, np.float32),
    ]:  # fmt: skip
        with pytest.raises(UserError, match="it: numbers that do not fit"):
            checks.check_fits("it", [0, value], np.dtype(kind))
    for value in ("1", None, 1j):
        with pytest.raises(UserError, match="it: numbers expected"):
            checks.check_fits("it", value, np.dtype(np.float32))


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

    def __post_init__(self) -> None:
        checks.check_types(self, "limit")


WRONG = {
    "count": [1.0, True, "1", None, 2**31, [1]],
    "share": [math.nan, math.inf, "1", None, True, 1e39],
    "known": [1, "yes", None],
    "name": [1, None, b"a"],
    "pair": [(0.5,), (0.5, math.nan), 0.5, None, "ab"],
    "many": [(1.0,), (True,), 1, "1"],
    "maybe": [1.0, "1", False],
    "limit": [math.nan, -math.inf, "1"],
}


@pytest.mark.parametrize("field", WRONG)
def test_fields_of_the_wrong_type_raise_an_error(field):
    for value in WRONG[field]:
        with pytest.raises(UserError, match=f"^{field} must be"):
            Example(**{field: value})


def test_configurations_convert_fields_to_plain_values():
    example = Example(
        np.int64(3), np.float32(0.5), np.True_, np.str_("b"), [1, np.float64(2)], np.arange(2),
        jnp.int32(4), math.inf,
    )  # fmt: skip
    assert example == Example(3, 0.5, True, "b", (1, 2.0), (0, 1), 4, math.inf)
    assert isinstance(hash(example), int)
    # A float field keeps an integer, because the name of a run depends on how JSON writes it.
    assert type(Example(share=1).share) is int
