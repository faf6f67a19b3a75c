"""Levels of the paper's analyses are what they are said to be."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minigrid.core.constants import DIR_TO_VEC

from experiments.properties import AGAIN, CASES, DETOUR_TURNS, FEW_TURNS, WatchedErrand
from leapjax.domains.babyai import demonstrations, observations
from leapjax.domains.babyai.adapter import END, NUM_ACTIONS, TURNS, BabyAIAdapter
from leapjax.domains.babyai.constraints import (
    hide_half_of_obstacles,
    hide_lava,
    hide_marks,
    hide_open_doors,
)
from leapjax.domains.babyai.dynamics import FLOOR, LAVA
from leapjax.domains.babyai.levels import LEVELS, find_level
from leapjax.domains.babyai.symmetries import AGENT, EMPTY
from leapjax.energy import from_total
from leapjax.rollouts import History

LAVA_LEVELS = {"GoToLavaEasy": (0, 2), "GoToLavaMedium": (0, 5), "GoToLavaHard": (4, 4)}
EPISODES = range(60)


def first(name, seed, past=0):
    """An adapter after reset, and the context that its episode begins with."""
    adapter = BabyAIAdapter(find_level(name))
    return adapter, History(adapter.reset(seed), past, adapter.num_actions).context()


def cells_of(observation, kind):
    return {tuple(map(int, cell)) for cell in np.argwhere(observation.grid[..., 0] == kind)}


@pytest.mark.parametrize("name", LAVA_LEVELS)
def test_there_is_as_much_lava_as_said_and_a_way_around_it(name):
    counts = Counter()
    for seed in EPISODES:
        adapter, context = first(name, seed)
        lava = cells_of(context.observation, LAVA)
        counts[len(lava)] += 1
        ways = observations.path_lengths(
            adapter.env.grid, observations.agent_cell(adapter.env), through_objects=False
        )
        assert adapter.goal in ways
        if name != "GoToLavaHard":
            straight(context.observation, adapter.goal, lava, wide=name == "GoToLavaMedium")
    low, high = LAVA_LEVELS[name]
    assert low <= min(counts) and max(counts) == high


def straight(observation, goal, lava, wide):
    """Lava is on the straight ways of agent and object, or beside them where it is wide."""
    x, y = map(int, observation.pose[:2])
    columns = range(min(x, goal[0]) + 1, max(x, goal[0]))
    rows = range(min(y, goal[1]) + 1, max(y, goal[1]))
    on_row = {(a, b) for a, b in lava if a in columns and abs(b - y) <= wide}
    on_column = {(a, b) for a, b in lava if b in rows and abs(a - x) <= wide}
    assert lava == on_row | on_column
    if not wide:
        assert len(on_row) <= 1 and len(on_column) <= 1
        assert len(columns) == 0 or on_row or (goal in [(a, y) for a in columns])


def fewest_turns(adapter, observation):
    """On ways that visit the coloured cell and then face the goal; None: there is no such way.

    Among things that are alike each is the goal, and none may be faced before the visit.
    """
    grid = observation.grid
    free = np.isin(grid[..., 0], (EMPTY, FLOOR, AGENT))
    goals = {tuple(map(int, cell)) for cell in np.argwhere((grid == grid[adapter.goal]).all(-1))}
    (mark,) = cells_of(observation, FLOOR)

    def front(x, y, direction):
        dx, dy = DIR_TO_VEC[direction]
        return int(x + dx), int(y + dy)

    found, layer, turns = set(), {(*map(int, observation.pose), False)}, 0
    while layer:
        stack = list(layer)
        while stack:  # moves are free
            x, y, direction, visited = state = stack.pop()
            ahead = front(x, y, direction)
            if ahead in goals and visited:
                return turns
            begins = not found  # what the agent faces as it begins does not matter
            if state in found or (ahead in goals and not begins):
                continue
            found.add(state)
            if free[ahead]:
                stack.append((*ahead, direction, visited or ahead == mark))
        turned = {(x, y, (d + by) % 4, v) for x, y, d, v in found for by in (-1, 1)}
        layer = {state for state in turned - found if state[3] or front(*state[:3]) not in goals}
        turns += 1
    return None


@pytest.mark.parametrize(
    ("level", "budget"), [("GoToVia", FEW_TURNS), ("GoToViaDetour", DETOUR_TURNS)]
)
def test_there_is_one_coloured_cell_and_turns_enough_to_visit_it(level, budget):
    adapter = WatchedErrand(level, budget)
    turns = Counter(fewest_turns(adapter, adapter.reset(seed)) for seed in EPISODES)
    assert budget // 2 < max(turns) <= budget
    seen = hide_marks(first(level, 0)[1]).observation
    assert not cells_of(jax.device_get(seen), FLOOR)


def test_the_planner_sees_no_lava_and_everything_else():
    _, context = first("GoToLavaHard", 3, past=2)
    lava = cells_of(context.observation, LAVA)
    seen = hide_lava(context).observation
    assert lava and not cells_of(jax.device_get(seen), LAVA)
    other = np.asarray(context.observation.grid[..., 0] != LAVA)
    np.testing.assert_array_equal(np.asarray(seen.grid)[other], context.observation.grid[other])
    assert (np.asarray(seen.grid)[~other] == [1, 0, 0]).all()


def test_a_way_to_plan_sees_open_doors_and_what_comes_back_costs_as_its_name_says():
    def total(params, memory, actions):
        return (memory.observation.grid[..., 0] == 4).sum().astype(float)

    counts = from_total(lambda params, context: context, total, NUM_ACTIONS)
    _, context = first("GoToObjMazeS4", 0)
    doors = len(cells_of(context.observation, 4))
    assert not cells_of(jax.device_get(hide_open_doors(context).observation), 4)
    _, closed = first("GoToObjMazeS4R2Close", 0)
    closed_doors = cells_of(closed.observation, 4)
    assert cells_of(jax.device_get(hide_open_doors(closed).observation), 4) == closed_doors
    assert doors and closed_doors
    (case,) = (case for case in CASES if case.name == "generalization-hard")
    for way in case.ways:
        energy = way.minimise([counts])
        found = energy.total((), energy.encode((), context), jnp.array(TURNS))
        seen = 0 if way.name.endswith("open doors seen as empty") else doors
        back = AGAIN if "exploring" in way.name else 0
        assert found == seen + back


def test_obstacles_are_between_agent_and_key_and_each_half_sees_its_own():
    for seed in EPISODES:
        adapter, context = first("GoToBehindObstacles", seed)
        pose, goal = context.observation.pose, np.array(adapter.goal)
        assert (abs(goal - pose[:2]) == 3).all()
        objects = {c for kind in (5, 6, 7) for c in cells_of(context.observation, kind)}
        obstacles = objects - {adapter.goal}
        assert len(obstacles) == 6
        low, high = np.minimum(goal, pose[:2]), np.maximum(goal, pose[:2])
        assert all(
            (low <= cell).all() and (cell <= high).all() for cell in map(np.array, obstacles)
        )
        halves = []
        for part in (0, 1):
            seen = jax.device_get(hide_half_of_obstacles(context, part).observation)
            halves.append({c for kind in (5, 6, 7) for c in cells_of(seen, kind)})
            assert adapter.goal in halves[-1] and len(halves[-1]) == 4
        assert halves[0] | halves[1] == objects and halves[0] & halves[1] == {adapter.goal}


def test_only_turns_slip_a_fifth_of_them_and_to_any_other_action():
    adapter = BabyAIAdapter(find_level("GoToObjMazeS4Slip"))

    def taken():
        adapter.reset(7)
        return [(adapter.step(0).truncated, adapter.taken)[1] for _ in range(30)]

    assert taken() == taken() and len(set(taken())) > 1  # a seed decides how it slips
    asked, slipped = Counter(), Counter()
    rng = np.random.default_rng(0)
    for seed in range(40):
        adapter.reset(seed)
        for action in rng.integers(0, END, 100).tolist():
            transition = adapter.step(action)
            assert transition.taken == adapter.taken
            asked[action] += 1
            slipped[action, adapter.taken] += 1
            if transition.terminated or transition.truncated:
                break
    for action in range(END):
        others = [slipped[action, taken] for taken in range(END) if taken != action]
        share = sum(others) / asked[action]
        assert (0.15 < share < 0.25) if action in TURNS else share == 0
        if action in TURNS:
            assert min(others) > 0.1 * sum(others)  # each is a fifth of them


@pytest.mark.parametrize("name", ["GoToObjMazeS4Slip", "GoToObjMazeS4Mistakes"])
def test_what_is_recorded_is_what_was_done(name):
    """The actions of a demonstration lead, on the plain level, through its states."""
    plain = BabyAIAdapter(LEVELS["GoToObjMazeS4"])
    for demonstration in demonstrations.collect(find_level(name), 5, 0).demonstrations:
        plain.reset(demonstration.seed)
        for step, action in enumerate(demonstration.actions.tolist(), start=1):
            transition = plain.step(action)
            wanted = demonstration.observations.grid[step]
            np.testing.assert_array_equal(transition.observation.grid, wanted)
        assert transition.success


def test_a_quarter_of_the_actions_are_mistakes(monkeypatch):
    """A random action is the one that the demonstrator wanted once in six times."""
    make_bot, wanted = demonstrations.make_bot, []

    def watched(env):
        bot = make_bot(env)
        replan = bot.replan
        bot.replan = lambda action: wanted.append(int(replan(action))) or wanted[-1]
        return bot

    monkeypatch.setattr(demonstrations, "make_bot", watched)
    for name, share in (("GoToObjMazeS4", 0.0), ("GoToObjMazeS4Mistakes", 0.25)):
        adapter, wrong = BabyAIAdapter(find_level(name)), []
        for seed in range(80):
            wanted.clear()
            demonstration = demonstrations.demonstrate(adapter, seed, Counter())
            if demonstration is not None:
                wrong.extend(demonstration.actions != wanted)
        assert len(wrong) > 700
        assert np.mean(wrong) == pytest.approx(share * 5 / 6, abs=0.04 if share else 0)


def test_mislabelled_demonstrations_are_the_same_but_for_labels():
    good = demonstrations.collect(LEVELS["GoToObjMazeS4"], 60, 0).demonstrations
    bad = demonstrations.collect(find_level("GoToObjMazeS4Mislabelled"), 60, 0).demonstrations
    for a, b in zip(good, bad, strict=True):
        np.testing.assert_array_equal(a.observations.grid, b.observations.grid)
    wrong = np.concatenate([a.actions != b.actions for a, b in zip(good, bad, strict=True)])
    assert abs(wrong.mean() - 0.25 * 5 / 6) < 0.05
