"""Checks JSON values against a schema.

A schema is a type, an instance of a class below, or a dictionary. A dictionary describes an object
with at least these fields. `int` and `float` describe finite numbers; a float may be written as an
integer.
"""

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

LARGEST = 1e18  # the largest number that a run could give


class Number(NamedTuple):
    """A number in a range.

    Attributes:
        least: the smallest number allowed.
        most: the largest number allowed.
        whole: whether it must be an integer.
    """

    least: float = -LARGEST
    most: float = LARGEST
    whole: bool = False


class OneOf(NamedTuple):
    """A text from a list.

    Attributes:
        texts: the allowed texts.
    """

    texts: Sequence[str]


class Each(NamedTuple):
    """An array whose elements share a schema.

    Attributes:
        schema: schema of every element.
        least: the smallest number of elements allowed.
    """

    schema: Any
    least: int = 0


class Named(NamedTuple):
    """An object of any names whose values share a schema.

    Attributes:
        schema: schema of every value.
        least: the smallest number of values allowed.
    """

    schema: Any
    least: int = 0


class Absent(NamedTuple):
    """A field that may be missing.

    Attributes:
        schema: schema of its value.
    """

    schema: Any


class Nullable(NamedTuple):
    """A value that may be null.

    Attributes:
        schema: schema of any other value.
    """

    schema: Any


Schema = Any
COUNT = Number(0, whole=True)
SEVERAL = Number(1, whole=True)
AMOUNT = Number(0)
POSITIVE = Number(1e-12)
KINDS = {str: "str", bool: "bool", dict: "object", list: "array"}


def parse_json(text: str) -> Any:
    """Parses a JSON text.

    Raises:
        ValueError: the text is not JSON, or an object names a field twice.
        RecursionError: the text is nested too deeply.
    """
    return json.loads(text, object_pairs_hook=_make_object)


def _make_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"an object names {twice!r} twice")
    return found


def find_problem(value: Any, schema: Schema, name: str = "") -> str | None:
    """Describes the first error of a value, with the path of the field; `None` if it is valid.

    Args:
        value: parsed JSON.
        schema: schema of the value.
        name: path from the outermost value to this value.
    """
    if isinstance(schema, Absent):
        schema = schema.schema
    if isinstance(schema, Nullable):
        return None if value is None else find_problem(value, schema.schema, name)
    if schema in (int, float):
        schema = Number(whole=schema is int)
    if isinstance(schema, Number):
        return _find_problem_of_number(value, schema, name)
    if isinstance(schema, OneOf):
        if value in schema.texts:
            return None
        return f"{name} is {_shorten(value)}, expected one of {', '.join(schema.texts)}"
    if isinstance(schema, dict):
        return _find_wrong_type(value, dict, name) or _find_problem_of_fields(value, schema, name)
    if isinstance(schema, Each | Named):
        kind = list if isinstance(schema, Each) else dict
        if wrong := _find_wrong_type(value, kind, name):
            return wrong
        if len(value) < schema.least:
            return f"{name or 'the value'} is empty"
        parts = enumerate(value) if isinstance(schema, Each) else value.items()
        found = (find_problem(part, schema.schema, f"{name}[{key!r}]") for key, part in parts)
        return next((each for each in found if each), None)
    return _find_wrong_type(value, schema, name)


def _find_problem_of_fields(
    value: dict[str, Any], fields: dict[str, Schema], name: str
) -> str | None:
    missing = [
        each for each, of in fields.items() if each not in value and not isinstance(of, Absent)
    ]
    if missing:
        return f"{name or 'a row'} without {', '.join(missing)}"
    path = f"{name}." if name else ""
    found = (
        find_problem(value[each], of, path + each) for each, of in fields.items() if each in value
    )
    return next((each for each in found if each), None)


def _find_problem_of_number(value: Any, number: Number, name: str) -> str | None:
    kind = int if number.whole else float
    if isinstance(value, bool) or not isinstance(value, int if number.whole else int | float):
        return f"{name} is a {type(value).__name__}, expected {kind.__name__}"
    if not -LARGEST < value < LARGEST:  # NaN too
        return f"{name} is {_shorten(value)}: no number that a run could give"
    if not number.least <= value <= number.most:
        most = "" if number.most == LARGEST else f" and at most {number.most}"
        return f"{name} is {_shorten(value)}, expected at least {number.least}{most}"
    return None


def _find_wrong_type(value: Any, kind: type, name: str) -> str | None:
    if isinstance(value, kind):
        return None
    if not name:
        return f"expected a JSON {KINDS[kind]}, got {type(value).__name__}"
    return f"{name} is a {type(value).__name__}, expected {KINDS[kind]}"


def _shorten(value: Any) -> str:
    return str(value)[:20]
