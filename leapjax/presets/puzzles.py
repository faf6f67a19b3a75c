"""Presets of puzzles: a plan is the whole solution, filled from its most certain position on."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from leapjax.configuration import AnyConfig
from leapjax.presets import common

EPISODES = 500
Preset = Callable[[str, str], AnyConfig]  # (level, method) -> configuration


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
    """

    domain: str
    level: str
    length: int
    demonstrations: int
    settings: Any
    training: Mapping[str, Any]
    network: Mapping[str, Any] = {}


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
    return common.configure(
        puzzle.domain,
        puzzle.level,
        method,
        preset,
        demos=puzzle.demonstrations,
        training=training,
        network={} if method in common.UNTRAINED else puzzle.network,
        planner=common.search(method, puzzle.length, puzzle.length, fill="confident"),
        domain_settings=puzzle.settings,
        episodes=EPISODES,
    )
