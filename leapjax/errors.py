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


def check_at_least(config: object, least: int, *names: str) -> None:
    """Refuses a configuration some of whose numbers are too small.

    Raises:
        ValueError: says which, and what is possible.
    """
    for name in names:
        if getattr(config, name) < least:
            raise ValueError(f"{name} must be at least {least}, got {getattr(config, name)}")
