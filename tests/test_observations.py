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

TURN_LEFT, FORWARD = 0, 2


def find_matches(env) -> list[tuple[int, int]]:
    """Finds the objects that an instruction of a single clause describes, from its text alone."""
    found = re.fullmatch(
        r"(?:go to|pick up|open) (?:the|a)( \w+)? (key|ball|box|door|object)"
        r"( in front of you| behind you| on your left| on your right)?",
        env.mission,
    )
    colour, kind, place = (part and part.strip() for part in found.groups())
    ahead = DIR_TO_VEC[env.agent_dir]
    right = np.array([-ahead[1], ahead[0]])
    sides = {"in front of you": ahead, "behind you": -ahead}
    sides |= {"on your right": right, "on your left": -right}

    def matches(cell):
        content = env.grid.get(*cell)
        return (
            content is not None
            and content.type in (("key", "ball", "box", "door") if kind == "object" else (kind,))
            and (not colour or content.color == colour)
            and (not place or np.dot(np.array(cell) - env.agent_pos, sides[place]) > 0)
        )

    return [cell for cell in np.ndindex(env.grid.width, env.grid.height) if matches(cell)]


@pytest.mark.parametrize("name", ["GoToLocalS8N7", "GoToSeqS5R2", "PickUpLoc"])
def test_an_observation_holds_the_whole_state(name):
    adapter, rng = BabyAIAdapter(levels.find_level(name)), np.random.default_rng(0)
    picked = 0
    for seed in range(5):
        observation = adapter.reset(seed)
        for _ in range(40):
            env = adapter.env
            expected = env.grid.encode()
            expected[tuple(env.agent_pos)] = OBJECT_TO_IDX["agent"], 0, env.agent_dir
            np.testing.assert_array_equal(observation.grid, expected)
            assert tuple(observation.pose) == (*env.agent_pos, env.agent_dir)
            held, names = env.carrying, (0, 0)
            if held:
                names = OBJECT_TO_IDX[held.type], COLOR_TO_IDX[held.color]
                picked += 1
            assert tuple(observation.carried) == names
            assert vocabulary.decode(observation.instruction) == env.mission
            transition = adapter.step(int(rng.choice(6, p=[0.15, 0.15, 0.4, 0.2, 0.05, 0.05])))
            observation = transition.observation
            if transition.terminated:
                break
    assert picked > 10  # the random walks carried objects


@pytest.mark.parametrize(
    ("name", "seeds", "least"),
    [("GoToLocalS8N7", 120, 20), ("GoToObjMazeS4R2Close", 25, 0), ("PickUpLoc", 120, 20)],
)
def test_the_goal_is_the_nearest_match(name, seeds, least):
    env, choices = levels.make_environment(levels.find_level(name)), 0
    for seed in range(seeds):
        with levels.silenced():
            env.reset(seed=seed)
        matches = find_matches(env)
        lengths = slow_path_lengths(env.grid, tuple(map(int, env.agent_pos)))
        # Ties go to the smaller x, then y; these levels' targets can all be reached.
        assert observations.nearest_goal(env) == min((lengths[c], c) for c in matches)[1], seed
        choices += len(matches) > 1
    assert choices >= least  # several objects matched


def draw_level(drawing: list[str], target: str) -> tuple:
    """Makes a drawn level: # wall, b ball, k key, D door, L locked door, f floor, @ agent."""
    env = levels.make_environment(levels.find_level("GoToLocalS7N5"))
    with levels.silenced():
        env.reset(seed=0)
    env.grid = Grid(7, 7)
    make = {
        "#": Wall,
        "b": lambda: Ball("red"),
        "k": lambda: Key("blue"),
        "D": lambda: Door("green"),
        "L": lambda: Door("green", is_locked=True),
        "f": lambda: Floor("purple"),
    }
    for x, y in np.ndindex(7, 7):
        symbol = f"#######{''.join(drawing)}#######"[7 * y + x]
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
        # Paths count, not distances: the upper ball is two cells away, but behind a wall.
        (["#@#b..#", "#.#####", "#.....#", "#....b#", "#.....#"], (5, 4)),
        # Ties: smaller x first, then smaller y.
        (["#..b..#", "#.....#", "#b.@.b#", "#.....#", "#..b..#"], (1, 3)),
        # A free ball, even if far, comes before a ball behind keys.
        (["#@kb..#", "#.kkk.#", "#...k.#", "#.kkk.#", "#....b#"], (5, 5)),
        # If keys block all balls, the path through the keys counts.
        (["#@..kb#", "#...kk#", "#.....#", "#kkk..#", "#bkb..#"], (3, 5)),
        # Paths lead through doors, closed or locked, and over coloured floors.
        (["#@D.b.#", "#.#####", "#.....#", "#.....#", "#....b#"], (4, 1)),
        (["#@L.b.#", "#.#####", "#.....#", "#.....#", "#....b#"], (4, 1)),
        (["#@f.b.#", "#.#####", "#.....#", "#.....#", "#....b#"], (4, 1)),
        # A ball enclosed by walls comes last, but can be the goal.
        (["#@#b#.#", "#.###.#", "#.....#", "#.....#", "#....b#"], (5, 5)),
        (["#@#b#.#", "#.###.#", "#.....#", "#.....#", "#.....#"], (3, 1)),
    ],
)
def test_walls_and_objects_block_paths_to_the_goal_but_doors_do_not(drawing, expected):
    assert observations.nearest_goal(draw_level(drawing, "red ball")) == expected
    missing = draw_level(drawing, "yellow box")
    assert observations.nearest_goal(missing) == observations.NO_GOAL


@pytest.mark.parametrize("name", ["GoToSeqS5R2", "BabyAI-PutNextLocal-v0"])
def test_instructions_with_several_targets_have_no_goal(name):
    adapter, several = BabyAIAdapter(levels.find_level(name)), 0
    for seed in range(10):
        goal = tuple(adapter.reset(seed).goal)
        if re.search(" and |then|after you|next to", adapter.env.mission):
            several += 1
            assert goal == observations.NO_GOAL == (-1, -1)
    assert several > 4


def test_the_goal_stays_fixed_during_an_episode():
    adapter, rng = BabyAIAdapter(levels.find_level("GoToLocalS8N7")), np.random.default_rng(1)
    nearer = 0
    for seed in range(60):
        goal = tuple(adapter.reset(seed).goal)
        for action in rng.choice([TURN_LEFT, FORWARD, FORWARD], 25).tolist():
            transition = adapter.step(action)
            assert tuple(transition.observation.goal) == goal
            if transition.terminated:
                break
            nearer += observations.nearest_goal(adapter.env) != goal
    assert nearer > 0  # another match became nearer, and the goal stayed


def test_a_level_larger_than_the_grid_raises_an_error():
    env = levels.make_environment(levels.find_level("GoToLocalS8N7"))
    env.reset(seed=0)
    with pytest.raises(UserError, match="8 by 8 cells, larger than the grid of 7"):
        observations.observe(env, 7, observations.NO_GOAL, np.zeros(5, np.int32))
