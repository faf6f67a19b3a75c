"""Presets of star graphs."""

from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.stars.domain import LARGE, Settings
from leapjax.presets.puzzles import Puzzle, make_presets

DEMONSTRATIONS = 100  # augmentation turns any graph into any other
TRAINING = {"steps": 4000, "batch": 128, "learning_rate": 1e-3}


def describe(name: str, method: str) -> Puzzle:
    """Returns the numbers of a level.

    Raises:
        UserError: the level is unknown.
    """
    star = graphs.find_level(name)
    puzzle = Puzzle("stars", name, star.length, DEMONSTRATIONS, Settings(), TRAINING)
    if method != "leap" or star.nodes <= LARGE:
        return puzzle
    # In large graphs a network learns only slowly which edge leads where.
    settings = Settings(fewer_arms=True, neighbours=True)
    return puzzle._replace(settings=settings, training={**TRAINING, "batch": 64})


paper, leapjax = make_presets(describe)
