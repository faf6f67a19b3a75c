"""The options of this domain, and what a level asks of a preset."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from leapjax.babyai.levels import Level, find_level
from leapjax.checks import check_at_least, check_types, check_within


@dataclasses.dataclass(frozen=True)
class Settings:
    """BabyAI: augmentation of demonstrations, and the encoders.

    Attributes:
        augment: Change training windows at random: mirror the level, recolour and rename objects,
            and restate the instruction.
        exchange_objects: With `augment`: also exchange keys, balls and boxes for each other.
        clutter: Largest share of the cells not needed by the demonstration to fill with random
            objects, in 0 .. 1.
        lookalikes: Clutter may share the kind or the colour of the target.
        false_starts: Share of training windows that begin with random moves, in 0 .. 1. It needs a
            context of 0.
        detours: Share of training windows that lead around obstacles, in 0 .. 1. It needs a context
            of 0.
        channels: Features of each grid cell.
        rounds: Rounds of convolution over the grid.
        fields: Learned distance fields; 0 leaves convolutions alone.
        sweeps: Rounds of value iteration that compute the distance fields.
        word_heads: Attention heads from cells to the words of the instruction; 0 for none.
        radius: Cells around the agent, in each direction, that are read one by one.
    """

    augment: bool = False
    exchange_objects: bool = False
    clutter: float = 0.0
    lookalikes: bool = False
    false_starts: float = 0.0
    detours: float = 0.0
    channels: int = 32
    rounds: int = 2
    fields: int = 8
    sweeps: int = 16
    word_heads: int = 0
    radius: int = 3

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "channels", most=10_000)
        check_at_least(self, 1, "sweeps", most=10_000)  # no way in any level is longer
        check_at_least(self, 0, "rounds", most=200)  # each is compiled by itself
        check_at_least(self, 0, "fields", "word_heads", most=1000)
        check_at_least(self, 0, "radius", most=100)  # no level is larger
        check_within(self, 0, 1, "clutter", "false_starts", "detours")


_EASY = ("GoToLocal", "GoToBehindObstacles", "PickUpLocal")  # tasks: one room, no words of place


# By method, how actions are drawn where there is much to do: noise leads out of dead ends. In the
# units of its energies: nats, or Q-values.
SEQUENCE_NOISE: Mapping[str, Mapping[str, Any]] = {
    **{name: {"temperature": 1.0} for name in ("leap", "bc", "dt", "iql", "mopo")},
    "bcq": {"temperature": 0.1},
    "plate": {"beams": 1, "temperature": 2.0},
}


def preset(name: str, preset: str) -> Mapping[str, Any]:
    """What a preset sets for a level, whatever the method: options by name.

    Chosen on validation levels (docs/tried.md).

    Raises:
        UserError: an unknown level.
    """
    level = find_level(name)
    paper = {"context": level.context, "horizon": level.horizon, "iterations": level.iterations}
    # Known for the paper's levels only: keys open no doors, and an instruction names kind and
    # colour, so that it cannot mean clutter.
    familiar = bool(level.task)
    ours = {
        "iterations": level.horizon,  # more than there are positions give nothing
        "steps": 4000 if _is_large(level) else 1000 if level.task in _EASY else 2000,
        "episodes": 500,  # a rate near 100% wants more of them than the paper's 200
        "augment": True,
        "exchange_objects": familiar,
        "clutter": 0.4 if familiar else 0.0,
        "sweeps": _sweeps(level),
        "word_heads": 4 if level.sequence else 0,
    }
    return {**paper, **ours} if preset == "leapjax" else paper


def tuned(name: str, method: str, preset: str) -> Mapping[str, Any]:
    """What a level changes of a method's own preset: options by name."""
    level = find_level(name)
    return _tuned_paper(level, method) if preset == "paper" else _tuned_leapjax(level, method)


def _tuned_paper(level: Level, method: str) -> Mapping[str, Any]:
    """LEAP is as in the authors' code (docs/experiments.md); contexts are the appendix's."""
    if method == "leap":
        options: dict[str, Any] = {"end": False, "repeat_state": False}
        if level.name == "PickUpLoc":  # learned from the state alone: one copy of each window
            options |= {"masking": "all", "microbatch": 0}
        if level.name.startswith("GoToObjMazeS7"):  # the appendix: 15 and 50, which learn less
            options |= {"horizon": 10, "iterations": 30}
        if level.horizon > 5:  # more copies of each window
            options["microbatch"] = 2
        return options
    if method in ("classifier", "plate", "random"):
        return {}
    return {"context": level.states - 1}  # the past ones


def _tuned_leapjax(level: Level, method: str) -> Mapping[str, Any]:
    """What validation levels say (docs/tried.md)."""
    options = dict(SEQUENCE_NOISE.get(method, {})) if level.sequence else {}
    if _is_large(level) and method == "leap":  # 3e-3 is too high here
        options["learning_rate"] = 1.5e-3
    return options


def _side(level: Level) -> int:
    """Of the grid of a level of the paper."""
    return max(level.rows, level.columns) * (level.room_size - 1) + 1


def _is_large(level: Level) -> bool:
    """Whether ways through a level are so long that they are hard to learn."""
    return bool(level.task) and _side(level) > 15


def _sweeps(level: Level) -> int:
    """As many rounds of value iteration as a long way through the level has cells."""
    if not level.task:
        return 48
    alone = level.rows * level.columns == 1
    return (2 if alone else 4) * _side(level)  # ways wind from room to room
