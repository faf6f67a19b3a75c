import re

import numpy as np
import pytest

from leapjax.domains.babyai import levels
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.errors import UserError

# The paper's appendix: side, rooms, objects, doors (table "BabyAI environment setting"), then
# K, T and N (table "BabyAI environment experiment details"). MiniGrid's limit of steps; that of a
# sequence is 100 for each of its goals.
PAPER = {
    "GoToLocalS7N5": (7, 1, 5, "none", 0, 5, 10, 49),
    "GoToLocalS8N7": (8, 1, 7, "none", 0, 5, 10, 64),
    "GoToObjMazeS4": (10, 9, 1, "open", 0, 10, 30, 144),
    "GoToObjMazeS7": (19, 9, 1, "open", 0, 15, 50, 441),
    "GoToObjMazeS4R2Close": (7, 4, 1, "closed", 0, 5, 10, 64),
    "PickUpLoc": (8, 1, 8, "none", 0, 5, 10, 64),
    "GoToSeqS5R2": (9, 4, 4, "closed", 20, 5, 10, None),
}


def reset(env, seed: int) -> str:
    """Starts a level and returns what it printed."""
    with levels.silenced() as output:
        env.reset(seed=seed)
    return output.getvalue()


def of_kind(env, *kinds: str) -> list:
    return [cell for cell in env.grid.grid if cell is not None and cell.type in kinds]


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_levels_are_as_in_its_tables(name):
    assert set(levels.LEVELS) == set(PAPER)
    side, rooms, objects, doors, context, horizon, iterations, limit = PAPER[name]
    level = levels.find_level(name)
    assert (level.context, level.horizon, level.iterations) == (context, horizon, iterations)
    env = levels.make_environment(level)
    lengths, limits = set(), set()
    for seed in range(50):
        reset(env, seed)
        assert env.max_steps == (limit or 100 * env.mission.count("go to"))
        limits.add(env.max_steps)
        lengths.add(len(re.findall(r"\w+|,", env.mission)))
        assert env.grid.encode().shape == (side, side, 3)
        assert env.num_rows * env.num_cols == rooms
        assert len(of_kind(env, "key", "ball", "box")) == objects
        found = of_kind(env, "door")
        if doors == "none":
            assert not found
        else:
            assert len(found) >= rooms - 1  # every room can be reached
            assert {door.is_open for door in found} == {doors == "open"}
            assert not any(door.is_locked for door in found)
    assert max(lengths) == level.words
    assert (len(limits) > 1) == (limit is None)


@pytest.mark.parametrize("typed", ["GoToLocalS7N6", "gotolocals7n5"])
def test_an_unknown_level_suggests_near_names(typed):
    with pytest.raises(UserError) as raised:
        levels.find_level(typed)
    message = str(raised.value)
    assert repr(typed) in message and "\n" not in message
    suggestion = message.split("did you mean", 1)[1]
    assert "GoToLocalS7N5" in suggestion
    with pytest.raises(UserError, match="registered BabyAI level$") as raised:
        levels.find_level("?!")
    assert all(name in str(raised.value) for name in PAPER)
    assert "did you mean" not in str(raised.value)


def test_every_registered_level_can_be_observed():
    shapes = {}
    for name in levels.registered_levels():
        adapter = BabyAIAdapter(levels.find_level(name))
        observation = adapter.reset(3)
        width, height = adapter.env.width, adapter.env.height
        side = max(width, height)
        assert observation.grid.shape == (side, side, 3), name
        # What pads a level that is not square is "unseen", which no cell inside is.
        assert (observation.grid[:width, :height, 0] > 0).all(), name
        assert not observation.grid[width:].any() and not observation.grid[:, height:].any(), name
        shapes[name] = (width, height)
    oblong = [name for name, (width, height) in shapes.items() if width != height]
    assert len(oblong) == 18
    assert shapes["BabyAI-OpenRedDoor-v0"] == (9, 5)


def test_level_generation_prints_nothing(capsys):
    level = levels.find_level("GoToSeqS5R2")
    env = levels.make_environment(level)
    noisy = [seed for seed in range(10) if reset(env, seed)]
    assert noisy  # else there is nothing to silence
    adapter = BabyAIAdapter(level)
    for seed in noisy:
        adapter.reset(seed)
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == ""


def test_a_seed_is_a_level():
    first, second = (BabyAIAdapter(levels.find_level("GoToObjMazeS4")) for _ in range(2))
    grids = {}
    for seed in range(5):
        a, b = first.reset(seed), second.reset(seed)
        np.testing.assert_array_equal(a.grid, b.grid)
        np.testing.assert_array_equal(a.instruction, b.instruction)
        grids[a.grid.tobytes()] = seed
    assert len(grids) == 5
