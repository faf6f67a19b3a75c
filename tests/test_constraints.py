"""Plans rolled through a grid world, and penalties on them."""

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
    exploring,
)
from leapjax.batching import compile_planner
from leapjax.domains.babyai.adapter import END, NUM_ACTIONS, BabyAIAdapter
from leapjax.domains.babyai.constraints import (
    goal_before_visit,
    immediate_lava,
    lava,
    left_turns,
    revisits,
    steps_to_visit,
    told_to_go,
    turns_over,
)
from leapjax.domains.babyai.dynamics import FLOOR, FORWARD, roll, steps_to
from leapjax.domains.babyai.levels import find_level
from leapjax.domains.babyai.vocabulary import decode
from leapjax.energy import constrain, from_total, pseudo_likelihood
from leapjax.planners import BeamConfig, GibbsConfig, bind
from leapjax.rollouts import History
from leapjax.types import mask_token

LEFT, RIGHT, PICKUP, MASK = 0, 1, 3, mask_token(NUM_ACTIONS)
rolled = jax.jit(roll)
steps_onto_lava = jax.jit(lava)


def context_of(adapter, observation):
    return History(observation, 0, adapter.num_actions).context()


@pytest.mark.parametrize(
    "name", ["GoToLocalS8N7", "GoToObjMazeS4", "GoToObjMazeS4R2Close", "GoToLavaHard", "PickUpLoc"]
)
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


def beside_lava(seed=0):
    """A context whose agent faces lava."""
    adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
    observation = adapter.reset(seed)
    ahead = (observation.pose[:2] + np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]))[
        observation.pose[2]
    ]
    grid = observation.grid.copy()
    grid[1:-1, 1:-1][grid[1:-1, 1:-1, 0] == 1] = [9, 0, 0]
    assert tuple(grid[tuple(ahead)]) != (1, 0, 0)
    return context_of(adapter, observation._replace(grid=grid))


def test_the_immediate_penalty_sees_one_step_and_the_other_all():
    context = beside_lava(seed=1)
    walk = jnp.array([FORWARD, FORWARD, FORWARD])
    later = jnp.array([LEFT, RIGHT, FORWARD])
    assert float(immediate_lava(context, walk)) == 1 and float(lava(context, walk)) >= 1
    assert float(immediate_lava(context, later)) == 0 and float(lava(context, later)) == 1
    assert float(lava(context, jnp.array([MASK, FORWARD, FORWARD]))) == 0
    turned = jnp.array([LEFT, RIGHT, RIGHT])  # stays in its cell
    assert float(lava(context, turned)) == 0


def test_left_turns_count_until_the_plan_ends():
    adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
    context = context_of(adapter, adapter.reset(0))
    assert float(left_turns(context, jnp.array([LEFT, RIGHT, LEFT, END, LEFT]))) == 2
    assert float(left_turns(context, jnp.array([MASK, LEFT, LEFT]))) == 0


def test_turns_that_are_remembered_and_planned_count_against_a_budget():
    adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
    context = History(adapter.reset(0), 3, adapter.num_actions).context()
    plan = jnp.array([LEFT, FORWARD, RIGHT, END, LEFT])
    assert [float(turns_over(context, plan, budget)) for budget in (3, 2, 1, 0)] == [0, 0, 1, 2]
    context = context._replace(actions=np.array([LEFT, FORWARD, RIGHT], np.int32))
    assert float(turns_over(context, plan, 3)) == 1
    assert float(turns_over(context, jnp.array([MASK, LEFT, LEFT]), 2)) == 0


def test_poses_count_as_often_as_the_agent_has_been_there():
    """As a list of the poses that it went through says, remembered, now and planned."""
    adapter, rng = BabyAIAdapter(find_level("GoToLocalS8N1")), np.random.default_rng(0)
    count, most, revisited = jax.jit(revisits), 6, 0
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


def test_what_is_not_chosen_yet_is_no_revisit():
    adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
    context = History(adapter.reset(0), 3, adapter.num_actions).context()
    assert float(revisits(context, jnp.array([MASK, LEFT, RIGHT]))) == 0
    assert float(revisits(context, jnp.array([LEFT, MASK, RIGHT]))) == 0
    assert float(revisits(context, jnp.array([LEFT, RIGHT, MASK]))) == 1
    assert float(revisits(context, jnp.array([LEFT, RIGHT, LEFT]))) == 2


def test_who_would_turn_for_ever_explores_where_coming_back_costs():
    def total(params, memory, actions):  # turns to the left, and gives up never
        return jnp.where((actions == END).any(), jnp.inf, jnp.sum(actions != LEFT))

    turning = from_total(lambda params, context: context, total, NUM_ACTIONS)
    steps, poses = 40, []
    for minimised in (turning, exploring(lambda energies: energies[0])([turning])):
        plan = jax.jit(bind(minimised, GibbsConfig(1, 2, temperature=0.0)))
        adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
        history = History(adapter.reset(0), steps, adapter.num_actions)
        seen = set()
        for step in range(steps):
            (action,) = plan((), jax.random.key(step), history.context()).actions.tolist()
            observation = adapter.step(action).observation
            history.advance(action, observation, 0.0)
            seen.add(tuple(observation.pose.tolist()))
        poses.append(len(seen))
    assert poses[0] == 4 and poses[1] > steps / 2


def test_handling_the_thing_in_front_can_be_spared():
    adapter = BabyAIAdapter(find_level("GoToLocalS8N1"))
    observation = adapter.reset(0)
    x, y, direction = observation.pose
    dx, dy = [(1, 0), (0, 1), (-1, 0), (0, -1)][direction]
    grid = observation.grid.copy()
    grid[x + dx, y + dy] = [5, 0, 0]  # a key
    context = History(observation._replace(grid=grid), 3, adapter.num_actions).context()
    plan = jnp.array([PICKUP, FORWARD, LEFT, PICKUP, END])  # the second time nothing is there
    assert [float(revisits(context, plan, handling)) for handling in (False, True)] == [4, 3]


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
        assert int(steps_to(jnp.array(start), jnp.array(cell))) == fewest


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


def test_turns_over_the_budget_are_counted_in_each_episode():
    adapter = WatchedErrand("GoToVia", FEW_TURNS)
    for seed in (0, 1):
        adapter.reset(seed)
        before = adapter.violations
        counts = [adapter.step(LEFT) and adapter.violations - before for _ in range(7)]
        assert counts == [0] * FEW_TURNS + [1, 2]


def test_who_should_pick_something_up_is_told_to_go_to_it():
    adapter = BabyAIAdapter(find_level("PickUpObjMazeS4"))
    context = context_of(adapter, adapter.reset(0))
    said = decode(context.observation.instruction)
    told = decode(np.asarray(told_to_go(context).observation.instruction))
    assert said.startswith("pick up the ") and told == said.replace("pick up", "go to")
