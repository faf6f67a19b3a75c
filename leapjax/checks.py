"""Checks of arguments: each returns the value in a plain type, or raises `UserError`.

A number is taken for what it says, never rounded, wrapped or truncated to fit.
"""

import dataclasses
import math
import operator
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.errors import UserError, first_line

T = TypeVar("T")
MOST = 2**31 - 1  # the largest int32, the integers that JAX computes with
LARGEST = float(np.finfo(np.float32).max)  # the largest number that JAX computes with
LARGEST_SEED = 2**32 - 1  # the largest seed that JAX's random keys tell from all others


def check_integer(name: str, value: Any, least: int = 0, most: int = MOST) -> int:
    """Returns an integer of Python.

    Args:
        name: of the argument, for the message.
        value: any integer type; booleans, floats and arrays of several numbers are refused.
        least: the smallest value allowed.
        most: the largest value allowed.

    Raises:
        UserError: not an integer, or out of range.
    """
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise UserError(f"{name} must be an integer, got {_shorten(value)}") from None
    if number < least:
        raise UserError(f"{name} must be at least {least}, got {_shorten(number)}")
    if number > most:
        raise UserError(f"{name} must be at most {most}, got {_shorten(number)}")
    return number


def check_number(name: str, value: Any, least: float = -LARGEST, most: float = LARGEST) -> float:
    """Returns a finite float of Python.

    Args:
        name: of the argument, for the message.
        value: any real number; booleans, texts and arrays are refused.
        least: the smallest value allowed.
        most: the largest value allowed.

    Raises:
        UserError: not a number, NaN, infinite, or out of range.
    """
    try:
        if isinstance(value, bool | np.bool_ | str | bytes) or np.ndim(value):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{name} must be a number, got {_shorten(value)}") from None
    if not math.isfinite(number):
        raise UserError(f"{name} must be finite, got {number}")
    if least <= number <= most:
        return number
    if least > -LARGEST and most < LARGEST:
        raise UserError(f"{name} must be in {least} .. {most}, got {number}")
    bound = f"at least {least}" if number < least else f"at most {most:g}"
    raise UserError(f"{name} must be {bound}, got {number}")


def check_kind(value: T, kind: type[T]) -> T:
    """Returns a value of one class.

    Raises:
        UserError: it is of another.
    """
    if not isinstance(value, kind):
        raise UserError(f"expected {kind.__name__}, got {type(value).__name__}")
    return value


def check_seed(value: Any, name: str = "seed") -> int:
    """Returns a seed: an integer in 0 .. 2^32 - 1, the seeds that JAX tells apart.

    Raises:
        UserError: any other value.
    """
    return check_integer(name, value, 0, LARGEST_SEED)


def check_seeds(values: Sequence[Any] | np.ndarray, name: str = "seed") -> np.ndarray:
    """Returns seeds as an array `[n]` uint32; see `check_seed`.

    Raises:
        UserError: one of them is no seed.
    """
    try:
        flat = np.ndim(values) == 1
    except ValueError:  # lists of several lengths
        flat = False
    if not flat:
        raise UserError(f"{name}s must be a sequence of integers, got {_shorten(values)}")
    whole = isinstance(values, np.ndarray | jax.Array) and np.issubdtype(values.dtype, np.integer)
    if whole and len(values):
        array = np.asarray(values)  # of one type, so that its extremes speak for all
        for extreme in (array.min(), array.max()):
            check_seed(extreme, name)
        return array.astype(np.uint32)
    return np.array([check_seed(value, name) for value in values], np.uint32)


def check_flag(name: str, value: Any) -> bool:
    """Returns a boolean of Python.

    Args:
        name: of the flag, for the message.
        value: true or false in any type, or 1 or 0; an array may hold one of these.

    Raises:
        UserError: anything else.
    """
    if isinstance(value, bool):
        return value
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "biuf" or array.item() not in (0, 1):
        raise UserError(f"{name} must be true or false, got {_shorten(value)}")
    return bool(array.item())


def check_counts(name: str, values: Sequence[Any], least: int = 0) -> np.ndarray:
    """Returns counts as an array `[n]` int64.

    Args:
        name: of the argument, for the message.
        values: any sequence of integers.
        least: the smallest value allowed.

    Raises:
        UserError: no sequence, or one of them is not an integer, or out of range.
    """
    return np.array(
        [check_integer(name, value, least) for value in _list_items(name, values)], np.int64
    )


def check_numbers(
    name: str, values: Sequence[Any], least: float = -LARGEST, most: float = LARGEST
) -> list[float]:
    """Returns finite floats of Python; see `check_number`.

    Raises:
        UserError: no sequence, or one of them is no such number.
    """
    return [check_number(name, value, least, most) for value in _list_items(name, values)]


def check_indices(name: str, values: Sequence[Any], count: int) -> tuple[int, ...]:
    """Returns the indices that a sequence of integers or a boolean mask names, sorted.

    Args:
        name: of the argument, for the message.
        values: distinct integers in 0 .. count - 1, or `[count]` booleans.
        count: how many there are to choose from.

    Raises:
        UserError: other types, an index out of range or named twice, a mask of another length.
    """
    items = _list_items(name, values)
    if items and all(isinstance(item, bool | np.bool_) for item in items):
        if len(items) != count:
            raise UserError(f"{name}: a mask of {len(items)} booleans, expected {count}")
        return tuple(index for index, item in enumerate(items) if item)
    indices = sorted(check_integer(name, item, 0, count - 1) for item in items)
    if len(set(indices)) < len(indices):
        raise UserError(f"{name} names one index twice: {indices}")
    return tuple(indices)


def check_fits(name: str, values: Any, dtype: np.dtype) -> np.ndarray:
    """Returns the same numbers in another type; a type of floats rounds them.

    Args:
        name: of the numbers, for the message.
        values: an array of booleans, integers or floats, or what NumPy makes one of.
        dtype: the type.

    Raises:
        UserError: no numbers, numbers that the type does not have, or NaN or infinite.
    """
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise UserError(f"{name}: numbers expected, got {array.dtype}")
    with np.errstate(over="ignore", invalid="ignore"):
        narrow = array.astype(dtype, copy=False)
    wrong = ~np.isfinite(narrow) if narrow.dtype.kind == "f" else narrow != array
    if wrong.any():
        raise UserError(
            f"{name}: numbers that do not fit {dtype}, or are not finite, such as {array[wrong][0]}"
        )
    return narrow


def check_range(name: str, values: np.ndarray, least: int, most: int) -> None:
    """Checks that all numbers of an array are in a range.

    Args:
        name: of the numbers, for the message.
        values: at least one.
        least: the smallest value allowed.
        most: the largest value allowed.

    Raises:
        UserError: a number is out of range.
    """
    if values.min() < least or values.max() > most:
        raise UserError(
            f"{name} run from {values.min()} to {values.max()}, expected {least} to {most}"
        )


def check_floats(name: str, values: Any, shape: tuple[int, ...]) -> jax.Array:
    """Returns real numbers as JAX's array of floats: unsigned integers have no negatives.

    Args:
        name: of the numbers, for the message.
        values: an array, or what JAX makes one of.
        shape: that they must have.

    Raises:
        UserError: another shape, or no real numbers.
    """
    try:
        # Python's integers may be larger than those of JAX.
        array = jnp.asarray(float(values) if isinstance(values, int) else values)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{name} must be numbers: {first_line(error)}") from error
    if array.shape != shape:
        expected = f"{name} must be of shape {shape}" if shape else f"{name} must be one number"
        raise UserError(f"{expected}, got shape {array.shape}")
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    if not (jnp.issubdtype(array.dtype, jnp.integer) or array.dtype == bool):
        raise UserError(f"{name} must be real numbers, got {array.dtype}")
    return array.astype(jnp.float32)


def check_types(config: Any, *unlimited: str, strategies: Sequence[str] = ()) -> None:
    """Checks that every field of a configuration holds what its type says.

    Numbers must be finite. A number of NumPy or JAX becomes Python's, so that a configuration can
    be hashed and written as JSON. Fields of other types than numbers, booleans, texts, tuples of
    them and None are not looked at.

    Args:
        config: an instance of a frozen dataclass.
        unlimited: fields that may be infinite.
        strategies: fields that may hold a function in place of its name.

    Raises:
        UserError: names the field, and what it holds.
    """
    types_of = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in unlimited and isinstance(value, float) and value == math.inf:
            continue
        if field.name in strategies and callable(value):
            continue
        checked = _check_type(field.name, value, types_of[field.name])
        if checked is not value:
            object.__setattr__(config, field.name, checked)


def _check_type(name: str, value: Any, kind: Any) -> Any:
    """The value, in the plain type that a field is declared with."""
    kinds = typing.get_args(kind)
    if type(None) in kinds:
        if value is None:
            return None
        return _check_type(name, value, next(each for each in kinds if each is not type(None)))
    if typing.get_origin(kind) is tuple:
        items = _list_items(name, value)
        every = kinds[:1] * len(items) if kinds[1:] == (...,) else kinds
        if len(items) != len(every):
            raise UserError(f"{name} must be {len(every)} values, got {_shorten(value)}")
        return tuple(_check_type(name, *each) for each in zip(items, every, strict=True))
    checked = value
    if kind is int:
        checked = check_integer(name, value, -MOST - 1)
    elif kind is float:
        checked = check_number(name, value)
    elif kind is bool and not isinstance(value, bool | np.bool_):
        raise UserError(f"{name} must be True or False, got {_shorten(value)}")
    elif kind is str and not isinstance(value, str):
        raise UserError(f"{name} must be a text, got {_shorten(value)}")
    elif kind in (bool, str):
        checked = kind(value)
    # An integer that stands for a number stays one: names of runs are made from what is written.
    return value if type(value) in (int, float, bool, str) else checked


def check_at_least(config: object, least: int, *names: str, most: int = MOST) -> None:
    """Checks fields of a configuration that are integers.

    Args:
        config: that has the fields.
        least: the smallest value allowed.
        names: of the fields.
        most: the largest value allowed.

    Raises:
        UserError: a field is not an integer, or out of range.
    """
    for name in names:
        check_integer(name, getattr(config, name), least, most)


def check_within(config: object, least: float, most: float, *names: str) -> None:
    """Checks fields of a configuration that are numbers.

    Args:
        config: that has the fields.
        least: the smallest value allowed.
        most: the largest value allowed.
        names: of the fields.

    Raises:
        UserError: a field is not a finite number, or out of range.
    """
    for name in names:
        check_number(name, getattr(config, name), least, most)


def _list_items(name: str, values: Any) -> list[Any]:
    """What a sequence holds."""
    try:
        if isinstance(values, str | bytes | Mapping):  # whose items are keys
            raise TypeError
        # Of an array of JAX as NumPy's, whose booleans and integers can be told apart.
        return list(np.asarray(values) if hasattr(values, "dtype") else values)
    except TypeError:
        raise UserError(f"{name} must be a sequence, got {_shorten(values)}") from None


def _shorten(value: Any) -> str:
    """A value as a message quotes it."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
