"""The one exception for a user's mistake: programs print it as one line and exit with 2."""

import difflib
from collections.abc import Iterable

LONGEST = 2000  # characters


class UserError(ValueError):
    """Input that cannot be used: says what was wrong, what was expected, what to do.

    It is one line, whatever the input that it quotes.

    Args:
        message: of any number of lines.
        fields: of configurations that would have to change; a command line names its options.
    """

    def __init__(self, message: str, *fields: str) -> None:
        super().__init__(" ".join(message.split())[:LONGEST])
        self.fields = fields


def first_line(error: Exception) -> str:
    """What another library's error says, short enough for one line of ours."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint at names that are nearly this one, to end a message with; empty where none is."""
    lowered = {candidate.lower(): candidate for candidate in known}
    near = difflib.get_close_matches(name.lower(), lowered, n=3, cutoff=0.4)
    return f"; did you mean {', '.join(lowered[match] for match in near)}?" if near else ""
