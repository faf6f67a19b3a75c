"""The one exception for a user's mistake: programs print it as one line and exit with 2."""


class UserError(ValueError):
    """Input that cannot be used: says what was wrong, what was expected, what to do."""
