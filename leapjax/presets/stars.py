"""Presets of star graphs."""

from leapjax.configuration import AnyConfig
from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.stars.domain import LARGE, Settings
from leapjax.presets.puzzles import Puzzle, configure

DEMONSTRATIONS = 100  # augmentation turns any graph into any other
TRAINING = {"steps": 4000, "batch": 128, "learning_rate": 1e-3}


def paper(name: str, method: str) -> AnyConfig:
    """Returns the paper's training; the paper's network cannot read graphs.

    Raises:
        UserError: the level is unknown.
    """
    return configure(_puzzle(name), method, "paper")


def leapjax(name: str, method: str) -> AnyConfig:
    """Returns our network and training.

    Raises:
        UserError: the level is unknown.
    """
    puzzle = _puzzle(name)
    if method == "leap" and graphs.find_level(name).nodes > LARGE:
        # In large graphs a network learns only slowly which edge leads where.
        puzzle = puzzle._replace(
            settings=Settings(fewer_arms=True, neighbours=True),
            training={**TRAINING, "batch": 64},
        )
    return configure(puzzle, method, "leapjax")


def _puzzle(name: str) -> Puzzle:
    length = graphs.find_level(name).length
    return Puzzle("stars", name, length, DEMONSTRATIONS, Settings(), TRAINING)
