"""Checks of arguments: each returns the value in a plain type, or raises `UserError`.

A number is taken for what it says, never rounded, wrapped or truncated to fit.
"""

import math
import operator
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from leapjax.errors import UserError

MOST = 2**31 - 1  # the largest int32, the integers that JAX computes with
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
        raise UserError(f"{name} must be an integer, got {_shown(value)}") from None
    if number < least:
        raise UserError(f"{name} must be at least {least}, got {_shown(number)}")
    if number > most:
        raise UserError(f"{name} must be at most {most}, got {_shown(number)}")
    return number


def check_number(name: str, value: Any, least: float = -math.inf, most: float = math.inf) -> float:
    """Returns a finite float of Python.

    Args:
        name: of the argument, for the message.
        value: any real number.
        least: the smallest value allowed.
        most: the largest value allowed.

    Raises:
        UserError: not a number, NaN, infinite, or out of range.
    """
    try:
        if isinstance(value, bool | np.bool_ | str | bytes):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{name} must be a number, got {_shown(value)}") from None
    if not math.isfinite(number):
        raise UserError(f"{name} must be finite, got {number}")
    if not least <= number <= most:
        raise UserError(f"{name} must be in {least} .. {most}, got {number}")
    return number


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
    if np.ndim(values) != 1:
        raise UserError(f"{name}s must be a sequence of integers, got {_shown(values)}")
    if isinstance(values, np.ndarray | jax.Array) and len(values):
        array = np.asarray(values)  # of one type, so that its extremes speak for all
        for extreme in (array.min(), array.max()):
            check_seed(extreme, name)
        return array.astype(np.uint32)
    return np.array([check_seed(value, name) for value in values], np.uint32)


def check_indices(name: str, values: Sequence[Any], count: int) -> tuple[int, ...]:
    """Returns the indices that a sequence of integers or a boolean mask names, sorted.

    Args:
        name: of the argument, for the message.
        values: distinct integers in 0 .. count - 1, or `[count]` booleans.
        count: how many there are to choose from.

    Raises:
        UserError: other types, an index out of range or named twice, a mask of another length.
    """
    items = list(values)
    if items and all(isinstance(item, bool | np.bool_) for item in items):
        if len(items) != count:
            raise UserError(f"{name}: a mask of {len(items)} booleans, expected {count}")
        return tuple(index for index, item in enumerate(items) if item)
    indices = sorted(check_integer(name, item, 0, count - 1) for item in items)
    if len(set(indices)) < len(indices):
        raise UserError(f"{name} names one index twice: {indices}")
    return tuple(indices)


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


def _shown(value: Any) -> str:
    """A value as a message quotes it."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
