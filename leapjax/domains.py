"""The table of domains: what `leapjax.load` and the experiments find by name."""

from leapjax.atari.domain import ATARI
from leapjax.babyai.domain import BABYAI
from leapjax.domain import DomainType
from leapjax.errors import UserError
from leapjax.gymnasium.domain import GYMNASIUM
from leapjax.stars.domain import STARS
from leapjax.sudoku.domain import SUDOKU

DOMAINS: dict[str, DomainType] = {
    "babyai": BABYAI, "stars": STARS, "sudoku": SUDOKU, "gymnasium": GYMNASIUM,
    "atari": ATARI,
}  # fmt: skip


def find_domain(name: str) -> DomainType:
    """The domain of that name.

    Raises:
        UserError: there is none; names those that there are.
    """
    if name not in DOMAINS:
        raise UserError(f"unknown domain {name!r}: expected one of {', '.join(DOMAINS)}")
    return DOMAINS[name]
