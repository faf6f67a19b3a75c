"""BabyAI levels as data: the paper's seven by name, any registered one by its id."""

import contextlib
import dataclasses
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
    """A level, and the settings of the paper for it (appendix, tables 4 and 7)."""

    name: str
    task: str = ""  # class in .worlds or minigrid.envs.babyai; empty: `name` is a registered id
    room_size: int = 0  # side of a room, walls included
    rows: int = 1  # rooms
    columns: int = 1  # rooms
    distractors: int = 0  # objects, the target included where the task draws it among them
    doors: str = "none"  # between rooms: "none", "open" or "closed"
    context: int = 0  # K, past steps in the context
    horizon: int = 5  # T
    iterations: int = 10  # N
    states: int = 5  # in the context of methods of single actions, the current one included
    words: int = vocabulary.LONGEST  # the longest instruction, in tokens
    sequence: bool = True  # an instruction may join several tasks, with "and" and "then"
    lava: int = 0  # cells, where the task has them
    slip: float = 0.0  # probability that a turn becomes one of the five other actions
    mistakes: float = 0.0  # share of a demonstrator's actions that are random ones
    mislabelled: float = 0.0  # share of a demonstration's actions that are replaced by random ones


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
    """One room, with the settings of the paper's."""
    return Level(name, task, side, distractors=objects, words=_GO_TO, sequence=False, **options)


def _like(name: str, paper: str, **options: Any) -> Level:
    """A level of the paper, and what differs from it."""
    return dataclasses.replace(LEVELS[paper], name=name, **options)


# Of the paper's analyses (section 5 and appendix): a maze of side 10 wants plans of ten actions.
_LONG = {"horizon": 10, "iterations": 30, "states": 10}
MODIFIED = {
    level.name: level
    for level in (
        # Online adaptation: what is learned has no lava.
        _room("GoToLocalS8N1", "GoToLocal", 8, **_LONG),
        _room("GoToLavaEasy", "GoToBehindLava", 8, lava=2),
        _room("GoToLavaMedium", "GoToBehindLava", 8, lava=worlds.MOST_LAVA),
        _like("GoToLavaHard", "GoToObjMazeS4", task="GoToAmongLava", lava=4),
        # An errand: what is learned has no coloured cell.
        _room("GoToVia", "GoToVia", 8),
        _room("GoToViaDetour", "GoToVia", 8, 7),
        # Generalisation: learned in one room.
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


def registered_levels() -> list[str]:
    """The ids of all BabyAI levels that MiniGrid registers."""
    return sorted(name for name in gym.registry if name.startswith("BabyAI-"))


def find_level(name: str) -> Level:
    """The level of that name or id.

    Raises:
        UserError: there is none; names the nearest.
    """
    own = {**LEVELS, **MODIFIED}
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
    """MiniGrid's environment of a level, without wrappers, not yet reset."""
    if not level.task:
        with silenced():
            return gym.make(level.name).unwrapped  # type: ignore[return-value]
    rooms = {"room_size": level.room_size, "num_rows": level.rows, "num_cols": level.columns}
    distractors = {"num_dists": level.distractors}
    # Each task takes only what it does not fix itself.
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
    """Level generation prints 'Sampling rejected: ...': not for our users."""
    return contextlib.redirect_stdout(io.StringIO())


def longest_episode(level: Level, env: RoomGridLevel) -> int:
    """The step limit of the level's longest instruction.

    MiniGrid's grows with the navigations that an instruction needs: 2 for each of 4 clauses.
    """
    navigations = 8 if level.sequence else 1
    grows = navigations * env.room_size**2 * env.num_rows * env.num_cols
    return max(env.max_steps or 0, grows)  # where the limit is not said beforehand it is 0
