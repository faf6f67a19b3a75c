"""Presets of puzzles: a plan is the whole solution, the most certain position first."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from leapjax.configuration import AnyConfig, Config
from leapjax.presets.common import (
    demonstrations,
    our_model,
    our_training,
    paper_model,
    paper_training,
    search,
    settings,
)

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
        model: changes of our network.
    """

    domain: str
    level: str
    length: int
    demonstrations: int
    settings: Any
    training: Mapping[str, Any]
    model: Mapping[str, Any] = {}


def configure(puzzle: Puzzle, method: str, preset: str) -> AnyConfig:
    """Makes the configuration of preset `leapjax`, our network, or `paper`, the paper's training.

    The paper's network has no encoder of puzzles.
    """
    training = dict(puzzle.training)
    if method == "leap":
        training["windows"] = "start"  # LEAP executes the whole plan, from the start of an episode
    ours = preset == "leapjax"
    return Config(
        domain=puzzle.domain,
        level=puzzle.level,
        method=method,
        preset=preset,
        demos=demonstrations(method, puzzle.demonstrations),
        episodes=EPISODES,
        model=our_model(method, **puzzle.model) if ours else paper_model(method),
        training=(our_training if ours else paper_training)(method, **training),
        planner=search(method, puzzle.length, puzzle.length, fill="confident"),
        method_settings=settings(method, masking="random" if ours else "each"),
        domain_settings=puzzle.settings,
    )
