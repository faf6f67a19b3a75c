"""Presets of puzzles: a plan is the whole solution, filled from its most certain position on."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from leapjax.configuration import AnyConfig
from leapjax.presets import common

EPISODES = 500
Preset = Callable[[str, str], AnyConfig]  # (level, method) -> configuration


# Plans again and again on turned copies of the puzzle, until the energy is sure of a plan. For
# puzzles with symmetries (`Domain.turn`); chosen on validation boards of 17 to 22 clues.
TURNED = {
    "fill": "confident", "certainty": 0.999, "restarts": 16, "judge": "halves", "enough": 0.02,
}  # fmt: skip


class Puzzle(NamedTuple):
    """The numbers of one level.

    Attributes:
        domain: name of the domain.
        level: name of the level.
        length: number of actions of a solution.
        demonstrations: number of demonstrations.
        settings: settings of the domain.
        training: changes of the preset's training.
        network: changes of our network.
        search: changes of how LEAP plans.
    """

    domain: str
    level: str
    length: int
    demonstrations: int
    settings: Any
    training: Mapping[str, Any]
    network: Mapping[str, Any] = {}
    search: Mapping[str, Any] = {}


def make_presets(describe: Callable[[str, str], Puzzle]) -> tuple[Preset, Preset]:
    """Makes the presets `paper` and `leapjax` of a puzzle.

    Args:
        describe: (level, method) -> numbers of the level, or UserError for an unknown level.
    """

    def make(preset: str, level: str, method: str) -> AnyConfig:
        return configure(describe(level, method), method, preset)

    return functools.partial(make, "paper"), functools.partial(make, "leapjax")


def configure(puzzle: Puzzle, method: str, preset: str) -> AnyConfig:
    """Makes the configuration of a level for preset `leapjax` or `paper`.

    `leapjax` is our network and training, `paper` the paper's. The paper's network has no encoder
    of puzzles, so `paper` needs another `ModelConfig.architecture`.
    """
    training = dict(puzzle.training)
    if method == "leap":
        training["windows"] = "start"  # LEAP executes the whole plan, from the start of an episode
    planner = common.search(method, puzzle.length, puzzle.length, fill="confident")
    if method == "leap":
        planner = dataclasses.replace(planner, **puzzle.search)
    return common.configure(
        puzzle.domain,
        puzzle.level,
        method,
        preset,
        demos=puzzle.demonstrations,
        training=training,
        network=puzzle.network,
        planner=planner,
        domain_settings=puzzle.settings,
        episodes=EPISODES,
    )
