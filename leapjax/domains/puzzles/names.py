"""Names of levels that hold numbers, such as Star3x5 and Sudoku9x36."""

import re
from collections.abc import Sequence

from leapjax.errors import UserError, did_you_mean


def read_numbers(name: str, pattern: str, expected: str, known: Sequence[str]) -> tuple[int, ...]:
    """Reads the numbers of a level's name, such as 3 and 5 of Star3x5.

    Args:
        name: of the level.
        pattern: a regular expression with a group for each number; groups may be optional.
        expected: the form of names, for the message.
        known: examples of names.

    Raises:
        UserError: the name does not match.
    """
    found = re.fullmatch(pattern, name)
    if found is None:
        raise UserError(
            f"unknown level {name!r}: expected {expected}, such as "
            f"{', '.join(known)}{did_you_mean(name, known)}"
        )
    return tuple(int(number) for number in found.groups() if number is not None)
