"""Plans rolled through a grid world, and penalties on them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.properties import (
    DETOUR_TURNS,
    FEW_TURNS,
    Watched,
    WatchedErrand,
    WatchedTurns,
)
from leapjax.batching import compile_planner
from leapjax.domains.babyai.adapter import END, NUM_ACTIONS, BabyAIAdapter
from leapjax.domains.babyai.constraints import (
    count_revisits,
    goal_before_visit,
    immediate_lava,
    lava,
    left_turns,
    replace_pick_up,
    steps_to_visit,
    turns_over,
)
from leapjax.domains.babyai.dynamics import FLOOR, FORWARD, count_steps, roll
from leapjax.domains.babyai.levels import find_level
from leapjax.domains.babyai.vocabulary import decode
from leapjax.energy import constrain, pseudo_likelihood
from leapjax.planners import BeamConfig, GibbsConfig
from leapjax.rollouts import History
from leapjax.types import mask_token

LEFT, RIGHT, PICKUP, MASK = 0, 1, 3, mask_token(NUM_ACTIONS)
HANDLING = [PICKUP, FORWARD, LEFT, PICKUP, END]
rolled = jax.jit(roll)
steps_onto_lava = jax.jit(lava)


def context_of(adapter, observation):
    return History(observation, 0, adapter.num_actions).context()


@pytest.mark.parametrize("name", ["GoToObjMazeS4R2Close", "GoToLavaHard", "PickUpLoc"])
def test_a_plan_of_turns_and_moves_is_rolled_as_minigrid_does(name):
    """Step by step, until the episode ends; and lava ends it where the penalty says so."""
    adapter, rng = BabyAIAdapter(find_level(name)), np.random.default_rng(0)
    entered = 0
    for seed in range(12):
        observation = adapter.reset(seed)
        actions = rng.choice([LEFT, RIGHT, FORWARD, FORWARD, FORWARD, FORWARD], 40)
        poses = np.asarray(rolled(observation, actions))
        np.testing.assert_array_equal(poses[0], observation.pose)
        for step, action in enumerate(actions.tolist(), start=1):
            transition = adapter.step(action)
            np.testing.assert_array_equal(transition.observation.pose, poses[step])
            if transition.terminated or transition.truncated:
                break
        died = transition.terminated and not transition.success
        entered += died
        tried = np.where(np.arange(40) < step, actions, END)
        found = float(steps_onto_lava(context_of(adapter, observation), tried))
        assert found == died
    assert (entered > 0) == (name == "GoToLavaHard")


def test_nothing_moves_after_the_end_nor_after_what_is_not_chosen_yet():
    adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
    observation = adapter.reset(0)
    for stop in (END, MASK):
        poses = np.asarray(rolled(observation, jnp.array([LEFT, stop, LEFT, RIGHT, RIGHT])))
        assert poses[1, 2] == (observation.pose[2] - 1) % 4
        assert (poses[1:] == poses[1]).all()


def facing(thing, fill=False):
    """A context whose agent faces a thing; or every free cell of the room holds it."""
    adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
    observation = adapter.reset(1)
    x, y, direction = observation.pose
    dx, dy = [(1, 0), (0, 1), (-1, 0), (0, -1)][direction]
    grid = observation.grid.copy()
    grid[x + dx, y + dy] = thing
    if fill:
        grid[1:-1, 1:-1][grid[1:-1, 1:-1, 0] == 1] = thing
    return History(observation._replace(grid=grid), 3, adapter.num_actions).context()


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
        (partial(turns_over, budget=3), TURNED, PLAN, 1),  # two are remembered
        (partial(turns_over, budget=2), TURNED, [MASK, LEFT, LEFT], 0),
        # What is not chosen yet is no revisit.
        (count_revisits, KEY_AHEAD, [MASK, LEFT, RIGHT], 0),
        (count_revisits, KEY_AHEAD, [LEFT, MASK, RIGHT], 0),
        (count_revisits, KEY_AHEAD, [LEFT, RIGHT, LEFT], 2),
        # Handling the thing in front can be spared; the second time nothing is there.
        (partial(count_revisits, handling=False), KEY_AHEAD, HANDLING, 4),
        (partial(count_revisits, handling=True), KEY_AHEAD, HANDLING, 3),
    ],
)
def test_penalties_of_plans_written_by_hand(penalty, context, plan, expected):
    assert float(penalty(context, jnp.array(plan))) == expected


def test_poses_count_as_often_as_the_agent_has_been_there():
    """As a list of the poses that it went through says, remembered, now and planned."""
    adapter, rng = BabyAIAdapter(find_level("GoToLocalS8N1")), np.random.default_rng(0)
    count, most, revisited = jax.jit(count_revisits), 6, 0
    for seed in range(30):
        history = History(adapter.reset(seed), most, adapter.num_actions)
        been = [tuple(history.context().observation.pose)]
        for action in rng.choice([LEFT, RIGHT, FORWARD], rng.integers(1, 12)).tolist():
            transition = adapter.step(action)
            history.advance(action, transition.observation, transition.reward)
            been.append(tuple(transition.observation.pose))
        been = been[-most - 1 :]
        plan = rng.choice([LEFT, RIGHT, FORWARD, END], 10, p=[0.3, 0.3, 0.3, 0.1])
        expected = 0
        for pose, action in zip(rolled(history.context().observation, plan)[1:], plan, strict=True):
            if action == END:
                break
            expected += been.count(tuple(np.asarray(pose)))
            been.append(tuple(np.asarray(pose)))
        assert float(count(history.context(), plan)) == expected
        revisited += expected
    assert revisited > 30


def test_steps_to_a_cell_are_the_fewest_turns_and_moves():
    size, start = 7, (3, 3, 0)
    found, layer = {}, [start]
    for steps in range(4 * size):  # breadth first, as MiniGrid turns and moves
        found |= dict.fromkeys((pose for pose in layer if pose not in found), steps)
        following = []
        for x, y, direction in layer:
            dx, dy = [(1, 0), (0, 1), (-1, 0), (0, -1)][direction]
            following += [(x, y, (direction + 1) % 4), (x, y, (direction - 1) % 4)]
            following += [(x + dx, y + dy, direction)]
        layer = [p for p in set(following) if p not in found and 0 <= min(p[:2]) <= max(p) < size]
    for cell in {pose[:2] for pose in found}:
        fewest = min(found[(*cell, direction)] for direction in range(4))
        assert int(count_steps(jnp.array(start), jnp.array(cell))) == fewest


@pytest.mark.parametrize(
    ("level", "budget"), [("GoToVia", FEW_TURNS), ("GoToViaDetour", DETOUR_TURNS)]
)
def test_a_plan_has_to_visit_the_coloured_cell_before_its_goal(level, budget):
    """As the world decides: it ends at the goal, and forgets a cell that was visited.

    Among several things that are alike each is the goal.
    """
    adapter, rng = WatchedErrand(level, budget), np.random.default_rng(0)
    distance, early = jax.jit(steps_to_visit), jax.jit(goal_before_visit)
    outcomes = set()
    for seed in range(40):
        observation = adapter.reset(seed)
        actions = rng.choice([LEFT, RIGHT, FORWARD, FORWARD, FORWARD], 60)
        before = History(observation, 0, adapter.num_actions).context()
        played = []
        for action in actions.tolist():
            violations = adapter.violations
            played.append(action)
            context = History(observation, 0, adapter.num_actions).context()
            transition = adapter.step(action)
            observation = transition.observation
            ended_early = transition.terminated and not transition.success
            assert float(early(context, jnp.array([action, MASK]))) == ended_early
            if ended_early:
                assert adapter.violations > violations
            if transition.terminated or transition.truncated:
                break
        tried = np.array(played + [END] * (60 - len(played)))
        missed = float(distance(before, tried))
        marks = (observation.grid[..., 0] == FLOOR).any()
        assert (missed > 0) == marks
        assert (missed >= observation.grid[..., 0].size) == ended_early
        outcomes.add((bool(marks), bool(transition.success)))
    assert outcomes >= {(True, False), (False, True)}


def test_beams_go_around_what_left_to_right_stands_in_front_of():
    """A prior that only turns and moves, told how far the cell is but not what is in the way."""
    sensible = jnp.isin(jnp.arange(NUM_ACTIONS), jnp.array([LEFT, RIGHT, FORWARD]))
    prior = pseudo_likelihood(
        lambda params, context: (),
        lambda params, memory, tokens, positions: jnp.tile(
            jnp.where(sensible, 0.0, -jnp.inf), (positions.shape[0], 1)
        ),
        NUM_ACTIONS,
    )
    told = constrain(
        prior, lambda context, actions: 5.0 * steps_to_visit(context, actions), partial=True
    )
    adapter = WatchedErrand("GoToViaDetour", DETOUR_TURNS)
    contexts = [context_of(adapter, adapter.reset(seed)) for seed in range(24)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *contexts)
    keys = jax.random.split(jax.random.key(0), len(contexts))
    far = {}
    for config in (GibbsConfig(10, 10, fill="sequential"), BeamConfig(10, beams=64)):
        plans = compile_planner(told, config)({}, keys, batch)
        far[type(config)] = jax.vmap(steps_to_visit)(batch, plans.actions)
    assert (far[BeamConfig] <= far[GibbsConfig]).all()
    around = (far[BeamConfig] == 0) & (far[GibbsConfig] > 0)
    assert around.sum() >= 3


@pytest.mark.parametrize("kind", [Watched, WatchedTurns])
def test_what_breaks_a_constraint_is_counted(kind):
    adapter, rng, deaths, turns = kind("GoToLavaHard"), np.random.default_rng(0), 0, 0
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


def test_who_should_pick_something_up_is_told_to_go_to_it():
    adapter = BabyAIAdapter(find_level("PickUpObjMazeS4"))
    context = context_of(adapter, adapter.reset(0))
    said = decode(context.observation.instruction)
    told = decode(np.asarray(replace_pick_up(context).observation.instruction))
    assert said.startswith("pick up the ") and told == said.replace("pick up", "go to")
