"""The one exception for a user's mistake: programs print it as one line and exit with 2."""

LONGEST = 2000  # characters


class UserError(ValueError):
    """Input that cannot be used: says what was wrong, what was expected, what to do.

    It is one line, whatever the input that it quotes.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split())[:LONGEST])


def first_line(error: Exception) -> str:
    """What another library's error says, short enough for one line of ours."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
