"""Presets of puzzles: a plan is the whole solution, the most certain position first."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from leapjax.configuration import AnyConfig
from leapjax.presets import common

EPISODES = 500


class Puzzle(NamedTuple):
    """The numbers of one level.

    Attributes:
        domain: its name.
        level: its name.
        length: actions of a solution.
        demonstrations: to learn from.
        settings: of the domain.
        training: changes of the training.
    """

    domain: str
    level: str
    length: int
    demonstrations: int
    settings: Any
    training: Mapping[str, Any]


def configure(puzzle: Puzzle, method: str, preset: str) -> AnyConfig:
    """Makes the configuration of preset `leapjax`, our network, or `paper`, the paper's training.

    The paper's network has no encoder of puzzles.
    """
    training = dict(puzzle.training)
    if method == "leap":
        training["windows"] = "start"  # LEAP executes the whole plan, from the start of an episode
    return common.configure(
        puzzle.domain,
        puzzle.level,
        method,
        preset,
        demos=puzzle.demonstrations,
        training=training,
        planner=common.search(method, puzzle.length, puzzle.length, fill="confident"),
        domain_settings=puzzle.settings,
        episodes=EPISODES,
    )
