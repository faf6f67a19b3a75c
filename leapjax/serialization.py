"""Reads and compares configurations as JSON, and hashes the identity of parameters."""

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from leapjax import files
from leapjax.errors import UserError, first_line

IDENTITY = "identity"  # array beside parameters: hash of the configuration that they belong to
T = TypeVar("T")


def hash_identity(identity: str) -> np.ndarray:
    """Returns the SHA-256 of an identity: `[32]` uint8."""
    return np.frombuffer(hashlib.sha256(identity.encode()).digest(), np.uint8)


def from_json(kind: type[T], values: Any, **types_of: type) -> T:
    """Makes a frozen configuration dataclass from JSON; inverts `dataclasses.asdict`.

    A missing field gets its default, so that files written before a setting was added stay valid.

    Args:
        kind: class of the dataclass.
        values: JSON object with the fields.
        types_of: types of fields that the dataclass leaves open, by name.

    Raises:
        UserError: a field is unknown, of another type, or missing without a default; or the
            dataclass refuses a value.
    """
    if not isinstance(values, dict):
        raise UserError(f"a {kind.__name__} must be a JSON object, got {type(values).__name__}")
    hints = typing.get_type_hints(kind) | types_of
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    nothing = dataclasses.MISSING
    needed = {n for n, f in fields.items() if f.default is f.default_factory is nothing}
    odd = sorted((values.keys() - fields.keys()) | (needed - values.keys()))
    if odd:
        raise UserError(
            f"{kind.__name__}: missing or unknown {', '.join(odd)}: expected what this version of "
            "leapjax writes; read it with the version that wrote it, or train again"
        )
    converted = {name: _convert(hints[name], value, name) for name, value in values.items()}
    try:
        return kind(**converted)
    except ValueError as error:
        raise UserError(f"{kind.__name__}: {error}") from None


def _convert(hint: Any, value: Any, name: str) -> Any:
    if hint is Any:
        return value
    if dataclasses.is_dataclass(hint):
        return from_json(hint, value)  # type: ignore[arg-type]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        return _convert(next(o for o in options if o is not type(None)), value, name)
    if typing.get_origin(hint) is tuple:
        element = typing.get_args(hint)[0]
        if isinstance(value, list):
            return tuple(_convert(element, item, name) for item in value)
    elif hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
        return value
    raise UserError(f"{name} must be of type {getattr(hint, '__name__', hint)}, got {value!r}")


def read_json(path: Path, most: int = files.LARGEST_TEXT) -> Any:
    """Reads a JSON file.

    Args:
        path: path of the file.
        most: the largest size allowed, in bytes.

    Raises:
        UserError: the file is missing, too large, or not JSON.
    """
    text = files.read_text(path, most)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid JSON ({first_line(error)})") from None


def find_differences(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that differ from their defaults, nested as given.

    A new setting whose default keeps the old behaviour does not change the result, nor names made
    from the result.
    """
    found = {}
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            value, default = find_differences(value, default), {}
        if value != default:
            found[name] = value
    return found
