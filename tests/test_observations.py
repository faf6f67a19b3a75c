import re

import numpy as np
import pytest
from minigrid.core.constants import COLOR_TO_IDX, DIR_TO_VEC, OBJECT_TO_IDX
from minigrid.core.grid import Grid
from minigrid.core.world_object import Ball, Door, Floor, Key, Wall
from minigrid.envs.babyai.core.verifier import GoToInstr, ObjDesc

from leapjax.domains.babyai import levels, observations, vocabulary
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.errors import UserError
from tests.oracles import slow_path_lengths

TURN_LEFT, FORWARD, PICKUP = 0, 2, 3


def matching_cells(env) -> list[tuple[int, int]]:
    """Where the instruction's words apply, from its text alone (single clause)."""
    found = re.fullmatch(
        r"(?:go to|pick up|open) (?:the|a)( \w+)? (key|ball|box|door|object)"
        r"( in front of you| behind you| on your left| on your right)?",
        env.mission,
    )
    colour, kind, place = (part and part.strip() for part in found.groups())
    ahead = DIR_TO_VEC[env.agent_dir]
    right = np.array([-ahead[1], ahead[0]])
    sides = {
        "in front of you": ahead,
        "behind you": -ahead,
        "on your right": right,
        "on your left": -right,
    }
    cells = []
    for x in range(env.grid.width):
        for y in range(env.grid.height):
            content = env.grid.get(x, y)
            if content is None or content.type == "wall":
                continue
            if kind != "object" and content.type != kind:
                continue
            if colour and content.color != colour:
                continue
            if place and np.dot(np.array([x, y]) - env.agent_pos, sides[place]) <= 0:
                continue
            cells.append((x, y))
    return cells


@pytest.mark.parametrize("name", ["GoToLocalS8N7", "GoToSeqS5R2", "PickUpLoc"])
def test_an_observation_is_the_whole_state(name):
    adapter = BabyAIAdapter(levels.find_level(name))
    rng = np.random.default_rng(0)
    picked = 0
    for seed in range(5):
        observation = adapter.reset(seed)
        for _ in range(40):
            env = adapter.env
            x, y = env.agent_pos
            assert tuple(observation.grid[x, y]) == (OBJECT_TO_IDX["agent"], 0, env.agent_dir)
            elsewhere = np.ones(observation.grid.shape[:2], bool)
            elsewhere[x, y] = False
            np.testing.assert_array_equal(observation.grid[elsewhere], env.grid.encode()[elsewhere])
            assert tuple(observation.pose) == (x, y, env.agent_dir)
            held = env.carrying
            if held:
                names = OBJECT_TO_IDX[held.type], COLOR_TO_IDX[held.color]
                assert tuple(observation.carried) == names
                picked += 1
            else:
                assert tuple(observation.carried) == (0, 0)
            assert vocabulary.decode(observation.instruction) == env.mission
            transition = adapter.step(int(rng.choice(6, p=[0.15, 0.15, 0.4, 0.2, 0.05, 0.05])))
            observation = transition.observation
            if transition.terminated:
                break
    assert picked > 10  # the walks did carry things


@pytest.mark.parametrize(
    ("name", "seeds"),
    [
        ("GoToLocalS8N7", 120),
        ("GoToObjMazeS4R2Close", 25),
        ("PickUpLoc", 120),
        ("BabyAI-Open-v0", 2),
    ],
)
def test_the_goal_is_the_nearest_match(name, seeds):
    env = levels.make_environment(levels.find_level(name))
    choices = 0
    for seed in range(seeds):
        with levels.silenced():
            env.reset(seed=seed)
        matches = matching_cells(env)
        start = tuple(map(int, env.agent_pos))
        lengths = slow_path_lengths(env.grid, start)
        # Ties go to the smaller x, then y; these levels' targets can all be reached.
        expected = sorted((lengths[cell], cell) for cell in matches)[0][1]
        assert observations.nearest_goal(env) == expected, seed
        choices += len(matches) > 1
    if name in ("GoToLocalS8N7", "PickUpLoc"):
        assert choices > 20  # there was something to choose


def hand_made(drawing: list[str], target: str) -> tuple:
    """A level drawn by hand: # wall, b red ball, k key, D closed door, L locked door, f floor,
    @ agent.
    """
    env = levels.make_environment(levels.find_level("GoToLocalS7N5"))
    with levels.silenced():
        env.reset(seed=0)
    env.grid = Grid(len(drawing[0]), len(drawing))
    make = {
        "#": Wall,
        "b": lambda: Ball("red"),
        "k": lambda: Key("blue"),
        "D": lambda: Door("green"),
        "L": lambda: Door("green", is_locked=True),
        "f": lambda: Floor("purple"),
    }
    for y, row in enumerate(drawing):
        for x, symbol in enumerate(row):
            if symbol in make:
                env.grid.set(x, y, make[symbol]())
            elif symbol == "@":
                env.agent_pos, env.agent_dir = (x, y), 0
    env.instrs = GoToInstr(ObjDesc(*target.split()[::-1]))
    env.instrs.reset_verifier(env)
    return env


@pytest.mark.parametrize(
    ("drawing", "expected"),
    [
        # Not as the crow flies: the upper ball is two cells away and behind a wall.
        (["#######", "#@#b..#", "#.#####", "#.....#", "#....b#", "#.....#", "#######"], (5, 4)),
        # Ties: smaller x first, then smaller y.
        (["#######", "#..b..#", "#.....#", "#b.@.b#", "#.....#", "#..b..#", "#######"], (1, 3)),
        # A ball walled in by keys counts after one that is far but free...
        (["#######", "#@kb..#", "#.kkk.#", "#...k.#", "#.kkk.#", "#....b#", "#######"], (5, 5)),
        # ... and where all are walled in, the nearest through the keys.
        (["#######", "#@..kb#", "#...kk#", "#.....#", "#kkk..#", "#bkb..#", "#######"], (3, 5)),
        # Doors are on the way, closed or locked.
        (["#######", "#@D.b.#", "#.#####", "#.....#", "#.....#", "#....b#", "#######"], (4, 1)),
        # Coloured floors are no obstacle.
        (["#######", "#@f.b.#", "#.#####", "#.....#", "#.....#", "#....b#", "#######"], (4, 1)),
        # Behind walls all around: still an answer, after all others.
        (["#######", "#@#b#.#", "#.###.#", "#.....#", "#.....#", "#....b#", "#######"], (5, 5)),
        (["#######", "#@#b#.#", "#.###.#", "#.....#", "#.....#", "#.....#", "#######"], (3, 1)),
    ],
)
def test_the_goal_in_levels_drawn_by_hand(drawing, expected):
    assert observations.nearest_goal(hand_made(drawing, "red ball")) == expected
    missing = hand_made(drawing, "yellow box")
    assert observations.nearest_goal(missing) == observations.NO_GOAL


@pytest.mark.parametrize("through_objects", [False, True])
def test_path_lengths_against_relaxation(through_objects):
    for name in ("GoToLocalS8N7", "GoToObjMazeS4R2Close", "BabyAI-OneRoomS8-v0"):
        env = levels.make_environment(levels.find_level(name))
        for seed in range(5):
            with levels.silenced():
                env.reset(seed=seed)
            start = tuple(map(int, env.agent_pos))
            expected = slow_path_lengths(env.grid, start, through_objects)
            assert observations.path_lengths(env.grid, start, through_objects) == expected


@pytest.mark.parametrize("name", ["GoToSeqS5R2", "BabyAI-PutNextLocal-v0"])
def test_several_targets_are_no_goal(name):
    adapter = BabyAIAdapter(levels.find_level(name))
    several = 0
    for seed in range(10):
        observation = adapter.reset(seed)
        if (
            " and " in adapter.env.mission
            or "then" in adapter.env.mission
            or "after you" in adapter.env.mission
            or "next to" in adapter.env.mission
        ):
            several += 1
        else:
            continue
        assert tuple(observation.goal) == observations.NO_GOAL == (-1, -1)
    assert several > 4


def test_the_goal_stays_for_the_whole_episode():
    adapter = BabyAIAdapter(levels.find_level("GoToLocalS8N7"))
    rng = np.random.default_rng(1)
    moved_on = 0
    for seed in range(60):
        goal = tuple(adapter.reset(seed).goal)
        for _ in range(25):
            transition = adapter.step(int(rng.choice([TURN_LEFT, FORWARD, FORWARD])))
            assert tuple(transition.observation.goal) == goal
            if transition.terminated:
                break
            moved_on += observations.nearest_goal(adapter.env) != goal
    assert moved_on > 0  # another match became nearer, and the goal still stayed


def test_a_level_larger_than_the_grid_is_refused():
    env = levels.make_environment(levels.find_level("GoToLocalS8N7"))
    env.reset(seed=0)
    with pytest.raises(UserError, match="8 by 8 cells, larger than the grid of 7"):
        observations.observe(env, 7, observations.NO_GOAL, np.zeros(5, np.int32))
