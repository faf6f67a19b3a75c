"""BabyAI levels as data: the paper's seven levels by name, any registered level by its id."""

import contextlib
import dataclasses
import functools
import io
from typing import Any

import gymnasium as gym
import minigrid  # noqa: F401  (registers the levels)
from minigrid.envs import babyai
from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel

from leapjax.domains.babyai import vocabulary, worlds
from leapjax.errors import UserError, did_you_mean


@dataclasses.dataclass(frozen=True)
class Level:
    """A level, and the paper's settings for it (appendix, tables 5 and 8).

    Attributes:
        name: name of the level, or its registered id.
        task: class in `.worlds` or `minigrid.envs.babyai`; empty if `name` is a registered id.
        room_size: side of a room in cells, walls included.
        rows: rows of rooms.
        columns: columns of rooms.
        distractors: number of objects, with the target if the task draws it from them.
        doors: doors between rooms: `none`, `open` or `closed`.
        context: K, past steps in LEAP's context.
        horizon: T, planned actions.
        iterations: N, planning iterations.
        states: states in the context of methods that choose one action at a time, with the current
            state.
        words: tokens of the longest instruction.
        sequence: whether an instruction may join several tasks with "and" and "then".
        lava: number of lava cells, in tasks with lava.
        slip: probability that a turn becomes another of MiniGrid's first six actions.
        mistakes: share of the demonstrator's actions that are random.
        mislabelled: share of a demonstration's recorded actions that are replaced at random.
        members: levels by name, of which each episode plays one, as its seed says.
    """

    name: str
    task: str = ""
    room_size: int = 0
    rows: int = 1
    columns: int = 1
    distractors: int = 0
    doors: str = "none"
    context: int = 0
    horizon: int = 5
    iterations: int = 10
    states: int = 5
    words: int = vocabulary.LONGEST
    sequence: bool = True
    lava: int = 0
    slip: float = 0.0
    mistakes: float = 0.0
    mislabelled: float = 0.0
    members: tuple[str, ...] = ()


def registered_levels() -> list[str]:
    """Lists the ids of all BabyAI levels that MiniGrid registers."""
    return sorted(name for name in gym.registry if name.startswith("BabyAI-"))


_GO_TO, _WITH_PLACE = 5, 9  # "go to the red ball", "pick up the red ball in front of you"
_SEQUENCE = 4 * _GO_TO + 4

LEVELS = {
    level.name: level
    for level in (
        Level("GoToLocalS7N5", "GoToLocal", 7, 1, 1, 5, words=_GO_TO, sequence=False),
        Level("GoToLocalS8N7", "GoToLocal", 8, 1, 1, 7, words=_GO_TO, sequence=False),
        Level(
            "GoToObjMazeS4", "GoTo", 4, 3, 3, 1, "open",
            horizon=10, iterations=30, states=10, words=_GO_TO, sequence=False,
        ),
        Level(
            "GoToObjMazeS7", "GoTo", 7, 3, 3, 1, "open",
            horizon=15, iterations=50, states=15, words=_GO_TO, sequence=False,
        ),
        Level(
            "GoToObjMazeS4R2Close", "GoTo", 4, 2, 2, 1, "closed",
            words=_GO_TO, sequence=False,
        ),
        Level("PickUpLoc", "PickupLoc", 8, 1, 1, 8, words=_WITH_PLACE, sequence=False),
        Level(
            "GoToSeqS5R2", "GoToSeq", 5, 2, 2, 4, "closed",
            context=20, states=20, words=_SEQUENCE,
        ),
    )
}  # fmt: skip


def _room(name: str, task: str, side: int, objects: int = 1, **options: Any) -> Level:
    """Makes a level with one room and the paper's settings for such levels."""
    return Level(name, task, side, distractors=objects, words=_GO_TO, sequence=False, **options)


def _like(name: str, paper: str, **options: Any) -> Level:
    """Makes a variant of a level of the paper."""
    return dataclasses.replace(LEVELS[paper], name=name, **options)


# Levels of the paper's analyses (section 6, appendix). Some have the settings of a maze of side 10.
_LONG = {"horizon": 10, "iterations": 30, "states": 10}
MODIFIED = {
    level.name: level
    for level in (
        # Online adaptation: the training level has no lava.
        _room("GoToLocalS8N1", "GoToLocal", 8, **_LONG),
        _room("GoToLavaEasy", "GoToBehindLava", 8, lava=2),
        _room("GoToLavaMedium", "GoToBehindLava", 8, lava=worlds.MOST_LAVA),
        _like("GoToLavaHard", "GoToObjMazeS4", task="GoToAmongLava", lava=4),
        # An errand: the training level has no coloured cell.
        _room("GoToVia", "GoToVia", 8),
        _room("GoToViaDetour", "GoToVia", 8, 7),
        # Generalisation: the training level is a single room.
        _room("GoToLocalS8N15", "GoToLocal", 8, 15),
        _room("GoToLocalS7N1", "GoToLocal", 7),
        _like("GoToObjMazeS4R2", "GoToObjMazeS4R2Close", doors="open"),
        _room("GoToLocalS10N1", "GoToLocal", 10, **_LONG),
        # Composition: of views of obstacles, and of tasks.
        _room("GoToBehindObstacles", "GoToBehindObstacles", 10, 6, **_LONG),
        _room("PickUpLocalS10N1", "PickUpLocal", 10, **_LONG),
        _like("PickUpObjMazeS4", "GoToObjMazeS4", task="PickUp"),
        # Stochastic dynamics, and imperfect demonstrations.
        *(_like(f"{name}Slip", name, slip=0.2) for name in ("GoToObjMazeS4", "GoToObjMazeS7")),
        *(
            _like(f"{name}{suffix}", name, **{what: 0.25})
            for name in ("GoToObjMazeS4", "GoToObjMazeS7", "GoToSeqS5R2")
            for suffix, what in (("Mistakes", "mistakes"), ("Mislabelled", "mislabelled"))
        ),
    )
}


# Levels that the planner of many levels (experiments/babyai.py) plays and never learns: four that
# show how it does on new levels; the twins of two of these, which differ in what counts as failure;
# and KeyInBox, which nobody demonstrates, because MiniGrid's bot opens no boxes.
HELD_OUT = (
    "BabyAI-GoToRedBlueBall-v0", "BabyAI-PickupDist-v0", "BabyAI-OpenDoorsOrderN4-v0",
    "BabyAI-PutNextS5N2-v0",
    "BabyAI-PickupDistDebug-v0", "BabyAI-OpenDoorsOrderN4Debug-v0",
    "BabyAI-KeyInBox-v0",
)  # fmt: skip
_FIRST = (
    "GoToObj", "GoToLocal", "GoTo", "Open", "Pickup", "PutNextLocal", "Unlock", "UnlockPickup",
    "GoToSeqS5R2", "Synth",
)  # fmt: skip
MIXTURES = {
    level.name: level
    for level in (
        Level(
            "BabyAI", members=tuple(name for name in registered_levels() if name not in HELD_OUT)
        ),
        Level("BabyAI10", members=tuple(f"BabyAI-{name}-v0" for name in _FIRST)),
    )
}


def list_played(level: Level) -> tuple[str, ...]:
    """Lists the levels that a planner of many levels plays: those it learned and those held out.

    The list is empty for a level without members.
    """
    return (*level.members, *HELD_OUT) if level.members else ()


def find_level(name: str) -> Level:
    """Finds a level by name or id.

    Raises:
        UserError: the level is unknown; names the most similar level.
    """
    own = {**LEVELS, **MODIFIED, **MIXTURES}
    if name in own:
        return own[name]
    if name in registered_levels():
        return Level(name)
    known = [*own, *registered_levels()]
    raise UserError(
        f"unknown level {name!r}: expected one of {', '.join(LEVELS)}, "
        f"or the id of a registered BabyAI level{did_you_mean(name, known)}"
    )


def make_environment(level: Level) -> RoomGridLevel:
    """Makes MiniGrid's environment of a level, without wrappers and not yet reset.

    Args:
        level: a level without members.
    """
    if not level.task:
        with silenced():
            return gym.make(level.name).unwrapped  # type: ignore[return-value]
    rooms = {"room_size": level.room_size, "num_rows": level.rows, "num_cols": level.columns}
    distractors = {"num_dists": level.distractors}
    # Each task takes only the arguments that it does not fix itself.
    arguments = {
        "GoToLocal": {"room_size": level.room_size, **distractors},
        "GoTo": {**rooms, **distractors, "doors_open": level.doors == "open"},
        "PickupLoc": {"room_size": level.room_size},
        "GoToSeq": {**rooms, **distractors},
        "GoToBehindLava": {"room_size": level.room_size, "wide": level.lava > 2},
        "GoToAmongLava": {**rooms, **distractors, "cells": level.lava},
        "GoToVia": {"room_size": level.room_size, **distractors},
        "GoToBehindObstacles": {"room_size": level.room_size, "obstacles": level.distractors},
        "PickUpLocal": {"room_size": level.room_size, **distractors},
        "PickUp": {**rooms, **distractors, "doors_open": level.doors == "open"},
    }[level.task]
    home = worlds if hasattr(worlds, level.task) else babyai
    return getattr(home, level.task)(**arguments)


def silenced() -> contextlib.redirect_stdout:
    """Hides the messages of level generation, 'Sampling rejected: ...'."""
    return contextlib.redirect_stdout(io.StringIO())


@functools.cache
def measure_level(level: Level) -> tuple[int, int]:
    """Makes the environments of a level; returns the side of its grid, and its step limit.

    MiniGrid's limit grows with the navigations that an instruction needs: 2 for each of 4 clauses.
    """
    if level.members:
        sizes = [measure_level(find_level(name)) for name in level.members]
        sides, limits = zip(*sizes, strict=True)
        return max(sides), max(limits)
    with contextlib.closing(make_environment(level)) as env:
        navigations = 8 if level.sequence else 1
        grows = navigations * env.room_size**2 * env.num_rows * env.num_cols
        limit = max(env.max_steps or 0, grows)  # 0 if the limit is unknown before the reset
        return max(env.width, env.height), limit
