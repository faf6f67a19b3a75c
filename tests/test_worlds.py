"""Levels of the paper's analyses, plans rolled through them, and penalties on the plans."""

from collections import Counter
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.properties import (
    AGAIN,
    CASES,
    DETOUR_TURNS,
    FEW_TURNS,
    Watched,
    WatchedErrand,
    WatchedTurns,
)
from leapjax.domains.babyai import demonstrations, observations
from leapjax.domains.babyai.adapter import END, NUM_ACTIONS, TURNS, BabyAIAdapter
from leapjax.domains.babyai.constraints import (
    count_revisits,
    goal_before_visit,
    hide_half_of_obstacles,
    hide_lava,
    hide_marks,
    hide_open_doors,
    immediate_lava,
    lava,
    left_turns,
    replace_pick_up,
    steps_to_visit,
    turns_over,
)
from leapjax.domains.babyai.dynamics import FLOOR, FORWARD, LAVA, count_steps, roll
from leapjax.domains.babyai.levels import LEVELS, find_level
from leapjax.domains.babyai.vocabulary import decode
from leapjax.energy import from_total
from leapjax.rollouts import History
from leapjax.types import mask_token
from tests.dynamics import FRONT
from tests.quick import quick_jit

LEFT, RIGHT, PICKUP, MASK = 0, 1, 3, mask_token(NUM_ACTIONS)
LAVA_LEVELS = {"GoToLavaEasy": (0, 2), "GoToLavaMedium": (0, 5), "GoToLavaHard": (4, 4)}
EPISODES = range(60)
ERRANDS = [("GoToVia", FEW_TURNS), ("GoToViaDetour", DETOUR_TURNS)]
compiled_roll = jax.jit(roll)
assert_equal = np.testing.assert_array_equal


def to_context(observation, past=0):
    return History(observation, past, NUM_ACTIONS).context()


def begin(name, seed, past=0):
    """Returns an adapter after reset, and the first context."""
    adapter = BabyAIAdapter(find_level(name))
    return adapter, to_context(adapter.reset(seed), past)


def find_cells(context, *kinds):
    cells = np.argwhere(np.isin(context.observation.grid[..., 0], kinds))
    return set(map(tuple, cells.tolist()))


@pytest.mark.parametrize("name", ["GoToObjMazeS4R2Close", "GoToLavaHard", "PickUpLoc"])
def test_roll_matches_minigrid_for_turns_and_moves(name):
    """Compares every pose of an episode, and the lava penalty with the death of the agent."""
    adapter, rng = BabyAIAdapter(find_level(name)), np.random.default_rng(0)
    entered, count = 0, jax.jit(lava)
    for seed in range(12):
        observation = adapter.reset(seed)
        actions = rng.choice([LEFT, RIGHT, FORWARD, FORWARD, FORWARD, FORWARD], 40)
        poses = np.asarray(compiled_roll(observation, actions))
        assert_equal(poses[0], observation.pose)
        for step, action in enumerate(actions.tolist(), start=1):
            transition = adapter.step(action)
            assert_equal(transition.observation.pose, poses[step])
            if transition.terminated or transition.truncated:
                break
        died = transition.terminated and not transition.success
        entered += died
        assert count(to_context(observation), np.where(np.arange(40) < step, actions, END)) == died
    assert (entered > 0) == (name == "GoToLavaHard")


def facing(thing, fill=False):
    """Makes a context whose agent faces a thing; `fill` puts it into every free cell."""
    observation = BabyAIAdapter(find_level("GoToLocalS8N1")).reset(1)
    grid = observation.grid.copy()
    grid[tuple(observation.pose[:2] + FRONT[observation.pose[2]])] = thing
    if fill:
        grid[1:-1, 1:-1][grid[1:-1, 1:-1, 0] == 1] = thing
    return to_context(observation._replace(grid=grid), 3)


HANDLING = [PICKUP, FORWARD, LEFT, PICKUP, END]
IN_LAVA, KEY_AHEAD = facing([9, 0, 0], fill=True), facing([5, 0, 0])
TURNED = KEY_AHEAD._replace(actions=np.array([LEFT, FORWARD, RIGHT], np.int32))
PLAN = [LEFT, FORWARD, RIGHT, END, LEFT]


@pytest.mark.parametrize(
    ("penalty", "context", "plan", "expected"),
    [
        (immediate_lava, IN_LAVA, [FORWARD, FORWARD, FORWARD], 1),
        (immediate_lava, IN_LAVA, [LEFT, RIGHT, FORWARD], 0),
        (lava, IN_LAVA, [LEFT, RIGHT, FORWARD], 1),
        (lava, IN_LAVA, [MASK, FORWARD, FORWARD], 0),
        (lava, IN_LAVA, [LEFT, RIGHT, RIGHT], 0),  # stays in its cell
        (left_turns, KEY_AHEAD, [LEFT, RIGHT, LEFT, END, LEFT], 2),
        (left_turns, KEY_AHEAD, [MASK, LEFT, LEFT], 0),
        (partial(turns_over, budget=2), KEY_AHEAD, PLAN, 0),
        (partial(turns_over, budget=1), KEY_AHEAD, PLAN, 1),
        (partial(turns_over, budget=3), TURNED, PLAN, 1),  # two turns are in the context
        (partial(turns_over, budget=2), TURNED, [MASK, LEFT, LEFT], 0),
        # Masked actions are no revisits.
        (count_revisits, KEY_AHEAD, [MASK, LEFT, RIGHT], 0),
        (count_revisits, KEY_AHEAD, [LEFT, MASK, RIGHT], 0),
        (count_revisits, KEY_AHEAD, [LEFT, RIGHT, LEFT], 2),
        # `handling` ignores the first PICKUP: the second faces an empty cell.
        (partial(count_revisits, handling=False), KEY_AHEAD, HANDLING, 4),
        (partial(count_revisits, handling=True), KEY_AHEAD, HANDLING, 3),
    ],
)
def test_penalties_of_hand_written_plans(penalty, context, plan, expected):
    assert float(quick_jit(penalty)(context, np.array(plan))) == expected


def test_revisits_count_all_earlier_visits_of_a_pose():
    """Compares with a list of the past, current and planned poses."""
    adapter, rng = BabyAIAdapter(find_level("GoToLocalS8N1")), np.random.default_rng(0)
    count, most, revisited = jax.jit(count_revisits), 6, 0
    for seed in range(30):
        history = History(adapter.reset(seed), most, adapter.num_actions)
        visited = [tuple(history.context().observation.pose)]
        for action in rng.choice([LEFT, RIGHT, FORWARD], rng.integers(1, 12)).tolist():
            transition = adapter.step(action)
            history.advance(action, transition.observation, transition.reward)
            visited.append(tuple(transition.observation.pose))
        visited, expected = visited[-most - 1 :], 0
        plan = rng.choice([LEFT, RIGHT, FORWARD, END], 10, p=[0.3, 0.3, 0.3, 0.1])
        ended = np.flatnonzero([*(plan == END), True])[0]
        for pose in np.asarray(compiled_roll(history.context().observation, plan))[1 : ended + 1]:
            expected += visited.count(tuple(pose))
            visited.append(tuple(pose))
        assert count(history.context(), plan) == expected
        revisited += expected
    assert revisited > 30


def test_count_steps_returns_the_fewest_turns_and_moves():
    size, start = 7, (3, 3, 0)
    found, layer = {}, [start]
    for steps in range(4 * size):  # breadth first, as MiniGrid turns and moves
        found |= dict.fromkeys((pose for pose in layer if pose not in found), steps)
        following = []
        for x, y, direction in layer:
            dx, dy = FRONT[direction]
            following += [(x, y, (direction + 1) % 4), (x, y, (direction - 1) % 4)]
            following += [(x + dx, y + dy, direction)]
        layer = [p for p in set(following) if p not in found and 0 <= min(p[:2]) <= max(p) < size]
    for cell in {pose[:2] for pose in found}:
        fewest = min(found[(*cell, direction)] for direction in range(4))
        assert int(count_steps(jnp.array(start), jnp.array(cell))) == fewest


@pytest.mark.parametrize(("level", "budget"), ERRANDS)
def test_visit_penalties_match_the_environment(level, budget):
    """The environment ends at the goal, and empties the coloured cell after a visit.

    Every object like the goal counts as the goal.
    """
    adapter, rng = WatchedErrand(level, budget), np.random.default_rng(0)
    distance, early = jax.jit(steps_to_visit), jax.jit(goal_before_visit)
    outcomes = set()
    for seed in range(40):
        now = before = to_context(adapter.reset(seed))
        assert len(find_cells(now, FLOOR)) == 1 and not find_cells(hide_marks(now), FLOOR)
        actions = rng.choice([LEFT, RIGHT, FORWARD, FORWARD, FORWARD], 60)
        for action in actions.tolist():
            violations, context = adapter.violations, now
            transition = adapter.step(action)
            now = to_context(transition.observation)
            ended_early = transition.terminated and not transition.success
            assert early(context, jnp.array([action, MASK])) == ended_early
            assert not ended_early or adapter.violations > violations
            if transition.terminated or transition.truncated:
                break
        played = np.where(np.arange(60) < adapter.env.step_count, actions, END)
        missed = distance(before, played)
        left = bool(find_cells(now, FLOOR))
        assert (missed > 0) == left
        assert (missed >= now.observation.grid[..., 0].size) == ended_early
        outcomes.add((left, bool(transition.success)))
    assert outcomes >= {(True, False), (False, True)}


@pytest.mark.parametrize("kind", [Watched, WatchedTurns])
def test_violations_of_constraints_are_counted(kind):
    adapter, rng = kind("GoToLavaHard"), np.random.default_rng(0)
    deaths = turns = 0
    for seed in range(20):
        adapter.reset(seed)
        for action in rng.choice([LEFT, RIGHT, FORWARD, FORWARD, FORWARD, FORWARD], 60).tolist():
            transition = adapter.step(action)
            deaths += transition.terminated and not transition.success
            turns += action == LEFT
            if transition.terminated or transition.truncated:
                break
    assert deaths > 2
    assert adapter.violations == deaths + (turns if kind is WatchedTurns else 0)
    adapter = WatchedErrand("GoToVia", FEW_TURNS)
    for seed in (0, 1):  # turns over the budget, in each episode
        adapter.reset(seed)
        before = adapter.violations
        counts = [adapter.step(LEFT) and adapter.violations - before for _ in range(7)]
        assert counts == [0] * FEW_TURNS + [1, 2]


def test_replace_pick_up_instructs_to_go_to_the_object():
    _, context = begin("PickUpObjMazeS4", 0)
    original = decode(context.observation.instruction)
    replaced = decode(np.asarray(replace_pick_up(context).observation.instruction))
    assert original.startswith("pick up the ") and replaced == original.replace("pick up", "go to")


@pytest.mark.parametrize("name", LAVA_LEVELS)
def test_lava_levels_have_the_specified_lava_and_a_path_around_it(name):
    counts = []
    for seed in EPISODES:
        adapter, context = begin(name, seed)
        counts.append(len(find_cells(context, LAVA)))
        start = observations.agent_cell(adapter.env)
        assert adapter.goal in observations.path_lengths(
            adapter.env.grid, start, through_objects=False
        )
    low, high = LAVA_LEVELS[name]
    assert low <= min(counts) and max(counts) == high


def test_hide_lava_changes_only_lava_cells():
    _, context = begin("GoToLavaHard", 3, past=2)
    where = context.observation.grid[..., 0] == LAVA
    visible = np.asarray(hide_lava(context).observation.grid)
    assert where.any() and (visible[where] == [1, 0, 0]).all()
    assert_equal(visible[~where], context.observation.grid[~where])


def test_ways_hide_open_doors_and_penalise_revisits_as_named():
    def total(params, memory, actions):
        return (memory.observation.grid[..., 0] == 4).sum().astype(float)

    counts = from_total(lambda params, context: context, total, NUM_ACTIONS)
    (_, context), (_, closed) = begin("GoToObjMazeS4", 0), begin("GoToObjMazeS4R2Close", 0)
    doors = len(find_cells(context, 4))
    assert doors and not find_cells(hide_open_doors(context), 4)
    assert find_cells(hide_open_doors(closed), 4) == find_cells(closed, 4) != set()
    (case,) = (case for case in CASES if case.name == "generalization-hard")
    for way in case.ways:
        energy = way.minimise([counts])
        visible = 0 if way.name.endswith("open doors seen as empty") else doors
        back = AGAIN if "exploring" in way.name else 0
        memory = quick_jit(energy.encode)((), context)
        found = quick_jit(energy.total)((), memory, np.array(TURNS))
        assert found == visible + back


def test_obstacles_lie_between_agent_and_key_and_split_into_halves():
    for seed in EPISODES:
        adapter, context = begin("GoToBehindObstacles", seed)
        pose, goal = context.observation.pose[:2], np.array(adapter.goal)
        assert (abs(goal - pose) == 3).all()
        objects = find_cells(context, 5, 6, 7)
        low, high = np.minimum(goal, pose), np.maximum(goal, pose)
        assert all((low <= cell).all() and (cell <= high).all() for cell in objects)
        one, other = (find_cells(hide_half_of_obstacles(context, part), 5, 6, 7) for part in (0, 1))
        assert len(objects) == 7 and len(one) == len(other) == 4
        assert one | other == objects and one & other == {adapter.goal}


def test_a_fifth_of_turns_slip_and_other_actions_never_slip():
    adapter = BabyAIAdapter(find_level("GoToObjMazeS4Slip"))

    def taken():
        adapter.reset(7)
        return [(adapter.step(0).truncated, adapter.taken)[1] for _ in range(30)]

    assert taken() == taken() and len(set(taken())) > 1  # the seed determines the slips
    counts, rng = np.zeros((END, END)), np.random.default_rng(0)
    for seed in range(40):
        adapter.reset(seed)
        for action in rng.integers(0, END, 100).tolist():
            transition = adapter.step(action)
            assert transition.taken == adapter.taken
            counts[action, adapter.taken] += 1
            if transition.terminated or transition.truncated:
                break
    shares = counts / counts.sum(axis=1, keepdims=True)
    for action, others in enumerate(shares):
        slipped = np.delete(others, action)
        assert (0.15 < slipped.sum() < 0.25) if action in TURNS else not slipped.any()
        assert action not in TURNS or slipped.min() > 0.02  # expected: 0.04 each


@pytest.mark.parametrize("name", ["GoToObjMazeS4Slip", "GoToObjMazeS4Mistakes"])
def test_demonstrations_record_the_executed_actions(name):
    """On the plain level, the actions of a demonstration lead through its states."""
    plain = BabyAIAdapter(LEVELS["GoToObjMazeS4"])
    for demonstration in demonstrations.collect(find_level(name), 5, 0).demonstrations:
        plain.reset(demonstration.seed)
        for step, action in enumerate(demonstration.actions.tolist(), start=1):
            transition = plain.step(action)
            assert_equal(transition.observation.grid, demonstration.observations.grid[step])
        assert transition.success


def test_a_quarter_of_the_actions_are_mistakes(monkeypatch):
    """A random action equals the bot's choice with probability 1/6."""
    bots, chosen = demonstrations.FullViewBot, []

    def watch_bot(env):
        bot = bots(env)
        replan = bot.replan
        bot.replan = lambda action: chosen.append(int(replan(action))) or chosen[-1]
        return bot

    monkeypatch.setattr(demonstrations, "FullViewBot", watch_bot)
    adapter, wrong = BabyAIAdapter(find_level("GoToObjMazeS4Mistakes")), []
    for seed in range(80):
        chosen.clear()
        demonstration = demonstrations.demonstrate(adapter, seed, Counter())
        if demonstration is not None:
            wrong.extend(demonstration.actions != chosen)
    assert len(wrong) > 700 and np.mean(wrong) == pytest.approx(0.25 * 5 / 6, abs=0.04)


def test_mislabelled_demonstrations_differ_only_in_their_labels():
    good = demonstrations.collect(LEVELS["GoToObjMazeS4"], 60, 0).demonstrations
    bad = demonstrations.collect(find_level("GoToObjMazeS4Mislabelled"), 60, 0).demonstrations
    for a, b in zip(good, bad, strict=True):
        assert_equal(a.observations.grid, b.observations.grid)
    wrong = np.concatenate([a.actions != b.actions for a, b in zip(good, bad, strict=True)])
    assert abs(wrong.mean() - 0.25 * 5 / 6) < 0.05
