"""The table of domains, in which `leapjax.load` and the experiments look up names."""

import importlib
import sys
from typing import Any, NamedTuple

from leapjax.checks import check_kind
from leapjax.domain import Domain, DomainType, drop_files
from leapjax.errors import UserError
from leapjax.extras import report_missing


class Place(NamedTuple):
    """Where a domain is defined; its module is imported at first use.

    Attributes:
        module: module that defines the domain.
        name: name of the `DomainType` in that module.
        extra: extra of this package that the domain needs; see `leapjax.extras`.
        about: description of the levels, for a line of help.
    """

    module: str
    name: str
    extra: str
    about: str


DOMAINS: dict[str, DomainType | Place] = {
    "babyai": Place(
        "leapjax.domains.babyai.domain", "BABYAI", "babyai",
        "BabyAI and MiniGrid: demonstrations are made",
    ),
    "gymnasium": Place(
        "leapjax.domains.gymnasium.domain", "GYMNASIUM", "train",
        "any Gymnasium environment with discrete actions, on a Minari data set",
    ),
    "atari": Place(
        "leapjax.domains.atari.domain", "ATARI", "atari", "Breakout, Pong, Qbert, Seaquest"
    ),
    "stars": Place(
        "leapjax.domains.puzzles.stars.domain", "STARS", "train",
        "star graphs: find the arm that leads to the goal",
    ),
    "sudoku": Place(
        "leapjax.domains.puzzles.sudoku.domain", "SUDOKU", "train", "boards with one solution"
    ),
    "countdown": Place(
        "leapjax.domains.puzzles.countdown.domain", "COUNTDOWN", "train",
        "reach a number with four operations on given numbers",
    ),
    "satisfiability": Place(
        "leapjax.domains.puzzles.satisfiability.domain", "SATISFIABILITY", "train",
        "formulas: find values that satisfy all clauses",
    ),
}  # fmt: skip


def find_domain(name: str) -> DomainType:
    """Finds a domain by name; imports its module.

    Raises:
        UserError: the domain is unknown, or needs an extra that is not installed.
    """
    if name not in DOMAINS:
        raise UserError(f"unknown domain {name!r}: expected one of {', '.join(DOMAINS)}")
    found = DOMAINS[name]
    if isinstance(found, Place):
        with report_missing(found.extra):
            found = getattr(importlib.import_module(found.module), found.name)
    return found


def make_level(name: str, level: str, settings: Any) -> Domain:
    """Makes one level of a domain; sets its `made_from`.

    Args:
        name: name of the domain.
        level: name of the level.
        settings: settings of the domain, an instance of its `DomainType.settings`.

    Raises:
        UserError: the domain or level is unknown, the settings are of another domain, or the
            environment cannot be made.
    """
    if not isinstance(level, str):
        raise UserError(f"a level must be a name, got {level!r}")
    kind = find_domain(name)
    check_kind(settings, kind.settings)
    return kind.make(level, settings)._replace(made_from=(name, drop_files(settings)))


def check_imported(level: str, named_by: str) -> None:
    """Checks that a level's module was imported: a file that names it must not run its code.

    A level `module:id` is an environment that a module registers, and making it runs the module's
    code. A user who trusts the module imports it first, or names the level.

    Args:
        level: name or id of the level.
        named_by: file or folder that names the level, for the message.

    Raises:
        UserError: the module has not been imported.
    """
    module, colon, _ = level.partition(":")
    if colon and module not in sys.modules:
        raise UserError(
            f"{named_by} names the level {level}, which would run the module {module}: if you "
            f"trust it, import {module} first, or name the level yourself"
        )
