"""The one exception for a user's mistake: programs print it as one line and exit with 2."""

import difflib
from collections.abc import Iterable

LONGEST = 2000  # characters


class UserError(ValueError):
    """Unusable input: the message names the mistake, the expected input and the remedy.

    The message is one line, even if it quotes input of several lines.

    Args:
        message: text of any number of lines, which are joined.
        fields: names of configuration fields to change; a command line names their options.
    """

    def __init__(self, message: str, *fields: str) -> None:
        super().__init__(" ".join(message.split())[:LONGEST])
        self.fields = fields


def first_line(error: Exception) -> str:
    """Returns the first line of another library's error, short enough to quote in our messages."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Returns a hint at similar names, to append to a message; "" if no name is similar."""
    lowered = {candidate.lower(): candidate for candidate in known}
    near = difflib.get_close_matches(name.lower(), lowered, n=3, cutoff=0.4)
    return f"; did you mean {', '.join(lowered[match] for match in near)}?" if near else ""
