"""Checks of arguments: each returns the value in a plain type, or raises `UserError`.

No check wraps or truncates a number to make it fit. Only conversions to floats round.
"""

import dataclasses
import functools
import math
import operator
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.errors import UserError, first_line

T = TypeVar("T")
MOST = 2**31 - 1  # the largest int32: JAX computes with int32
LARGEST = float(np.finfo(np.float32).max)  # JAX computes with float32
LARGEST_SEED = 2**32 - 1  # JAX's random keys distinguish all seeds up to this


def check_integer(name: str, value: Any, least: int = 0, most: int = MOST) -> int:
    """Returns a Python integer.

    Args:
        name: name of the argument, for the error message.
        value: value of any integer type, but no boolean, float or array of several numbers.
        least: the smallest value allowed.
        most: the largest value allowed.

    Raises:
        UserError: the value is not an integer, or is out of range.
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
    """Returns a finite Python float.

    Args:
        name: name of the argument, for the error message.
        value: any real number, but no boolean, text or array.
        least: the smallest value allowed.
        most: the largest value allowed.

    Raises:
        UserError: the value is not a number, is NaN or infinite, or is out of range.
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
    """Returns the value if it is an instance of a class.

    Of a dataclass it must be no subclass: nothing would read the further fields.

    Raises:
        UserError: the value is of another class.
    """
    exact = dataclasses.is_dataclass(kind)
    if not (type(value) is kind if exact else isinstance(value, kind)):
        expected, got = kind.__name__, type(value).__name__
        if expected == got:  # such as the Settings of two methods
            expected, got = f"{kind.__module__}.{expected}", f"{type(value).__module__}.{got}"
        raise UserError(f"expected {expected}, got {got}")
    return value


def check_seed(value: Any, name: str = "seed") -> int:
    """Returns a seed: an integer in 0 .. 2^32 - 1, the range that JAX distinguishes.

    Raises:
        UserError: the value is not an integer in this range.
    """
    return check_integer(name, value, 0, LARGEST_SEED)


def check_seeds(values: Sequence[Any] | np.ndarray, name: str = "seed") -> np.ndarray:
    """Returns seeds as an array `[n]` uint32; see `check_seed`.

    Raises:
        UserError: the values are not a sequence, or `check_seed` refuses a value.
    """
    try:
        flat = np.ndim(values) == 1
    except ValueError:  # lists of several lengths
        flat = False
    if not flat:
        raise UserError(f"{name}s must be a sequence of integers, got {_shorten(values)}")
    whole = isinstance(values, np.ndarray | jax.Array) and np.issubdtype(values.dtype, np.integer)
    if whole and len(values):
        array = np.asarray(values)  # of one type, so checking the extremes checks all
        for extreme in (array.min(), array.max()):
            check_seed(extreme, name)
        return array.astype(np.uint32)
    return np.array([check_seed(value, name) for value in values], np.uint32)


def check_flag(name: str, value: Any) -> bool:
    """Returns a Python boolean.

    Args:
        name: name of the flag, for the error message.
        value: true, false, 1 or 0 in any type, or an array with a single such element.

    Raises:
        UserError: any other value.
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
        name: name of the argument, for the error message.
        values: any sequence of integers.
        least: the smallest value allowed.

    Raises:
        UserError: the values are not a sequence, or a value is not an integer or out of range.
    """
    return np.array(
        [check_integer(name, value, least) for value in _list_items(name, values)], np.int64
    )


def check_numbers(name: str, values: Sequence[Any], least: float = -LARGEST) -> list[float]:
    """Returns finite Python floats; see `check_number`.

    Raises:
        UserError: the values are not a sequence, or `check_number` refuses a value.
    """
    return [check_number(name, value, least) for value in _list_items(name, values)]


def check_indices(name: str, values: Sequence[Any], count: int) -> tuple[int, ...]:
    """Returns the sorted indices that a sequence of integers or a boolean mask selects.

    Args:
        name: name of the argument, for the error message.
        values: distinct integers in 0 .. count - 1, or `[count]` booleans.
        count: number of elements to select from.

    Raises:
        UserError: the values have other types, an index is out of range or occurs twice, or a mask
            has another length.
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
    """Converts numbers to another type; types of floats round them.

    Args:
        name: name of the numbers, for the error message.
        values: booleans, integers or floats, as an array or as a value that NumPy converts.
        dtype: type to convert to.

    Raises:
        UserError: the values are not numbers, are not finite, or do not fit the type.
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
        name: name of the numbers, for the error message.
        values: array of at least one number.
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
    """Converts real numbers to a JAX array of floats: unsigned integers have no negatives.

    Args:
        name: name of the numbers, for the error message.
        values: array, or a value that JAX converts to an array.
        shape: required shape.

    Raises:
        UserError: the array has another shape, or its elements are not real numbers.
    """
    try:
        # Python's integers may exceed the range of JAX's.
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
    """Checks that the fields of a configuration have their declared types.

    Numbers must be finite. NumPy and JAX numbers become Python numbers, so that a configuration
    can be hashed and written as JSON. The check covers numbers, booleans, texts, `None`, and tuples
    of these; it skips fields of other types.

    Args:
        config: instance of a frozen dataclass.
        unlimited: names of fields that may be infinite.
        strategies: names of fields that may hold a function in place of its name.

    Raises:
        UserError: a field has another type; names the field and its value.
    """
    types_of = _find_types(config.__class__)
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in unlimited and isinstance(value, float) and value == math.inf:
            continue
        if field.name in strategies and callable(value):
            continue
        checked = _check_type(field.name, value, types_of[field.name])
        if checked is not value:
            object.__setattr__(config, field.name, checked)


@functools.cache  # the tables of documents make thousands of configurations
def _find_types(kind: type) -> dict[str, Any]:
    """Finds the declared types of a class's fields."""
    return typing.get_type_hints(kind)


def _check_type(name: str, value: Any, kind: Any) -> Any:
    """Checks a value against the declared type of its field; returns it as a Python value."""
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
    elif kind is Path and not isinstance(value, str | Path):
        raise UserError(f"{name} must be a path, got {_shorten(value)}")
    elif kind in (bool, str, Path):
        checked = kind(value)
    # An integer in a field of floats stays an integer: the names of runs depend on its text.
    return value if kind is not Path and type(value) in (int, float, bool, str) else checked


def check_at_least(config: object, least: int, *names: str, most: int = MOST) -> None:
    """Checks integer fields of a configuration.

    Args:
        config: configuration with the fields.
        least: the smallest value allowed.
        names: names of the fields.
        most: the largest value allowed.

    Raises:
        UserError: a field is not an integer, or out of range.
    """
    for name in names:
        check_integer(name, getattr(config, name), least, most)


def check_within(config: object, least: float, most: float, *names: str) -> None:
    """Checks number fields of a configuration.

    Args:
        config: configuration with the fields.
        least: the smallest value allowed.
        most: the largest value allowed.
        names: names of the fields.

    Raises:
        UserError: a field is not a finite number, or out of range.
    """
    for name in names:
        check_number(name, getattr(config, name), least, most)


def _list_items(name: str, values: Any) -> list[Any]:
    """Returns the elements of a sequence as a list."""
    try:
        if isinstance(values, str | bytes | Mapping):  # its items would be keys
            raise TypeError
        # Converts JAX arrays: the elements of NumPy arrays tell booleans from integers.
        return list(np.asarray(values) if hasattr(values, "dtype") else values)
    except TypeError:
        raise UserError(f"{name} must be a sequence, got {_shorten(values)}") from None


def _shorten(value: Any) -> str:
    """Returns a value as text of at most 60 characters, for an error message."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
