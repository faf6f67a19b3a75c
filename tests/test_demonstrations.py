import functools
from collections import Counter

import jax
import numpy as np
import pytest
from minigrid.core.world_object import Door
from minigrid.utils.baby_ai_bot import BabyAIBot

from leapjax.data import seeds
from leapjax.domain import Collection
from leapjax.domains.babyai import demonstrations, levels, observations
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.demonstrations import FAILED, OTHER_GOAL, FullViewBot
from leapjax.domains.babyai.observations import Observation
from leapjax.errors import UserError
from leapjax.types import Demonstration
from tests.oracles import assert_same_observation, slow_path_lengths

FORWARD, PICKUP, DROP, TOGGLE = 2, 3, 4, 5
FRONT = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
COUNTS = {
    "GoToLocalS7N5": 20,
    "GoToLocalS8N7": 20,
    "GoToObjMazeS4": 10,
    "GoToObjMazeS7": 2,
    "GoToObjMazeS4R2Close": 15,
    "PickUpLoc": 15,
    "GoToSeqS5R2": 8,
    "BabyAI-PutNextLocal-v0": 5,
    "BabyAI-UnlockLocal-v0": 5,
}


@functools.cache
def collected(name: str) -> Collection:
    return demonstrations.collect(levels.find_level(name), COUNTS[name], seed=5)


def reset(name: str, seed: int):
    env = levels.make_environment(levels.find_level(name))
    with levels.silenced():
        env.reset(seed=seed)
    return env


def state(demonstration: Demonstration, index: int) -> Observation:
    return jax.tree.map(lambda leaf: leaf[index], demonstration.observations)


@pytest.mark.parametrize("name", COUNTS)
def test_a_demonstration_can_be_replayed_from_its_seed(name):
    adapter = BabyAIAdapter(levels.find_level(name))
    result = collected(name)
    assert len(result.demonstrations) == COUNTS[name]
    for demonstration in result.demonstrations:
        assert len(demonstration.observations.pose) == len(demonstration.actions) + 1
        assert_same_observation(adapter.reset(demonstration.seed), state(demonstration, 0))
        for index, action in enumerate(demonstration.actions):
            transition = adapter.step(int(action))
            last = index == len(demonstration.actions) - 1
            assert_same_observation(transition.observation, state(demonstration, index + 1))
            assert np.float32(transition.reward) == demonstration.rewards[index]
            assert transition.success == transition.terminated == last
            assert not transition.truncated or last
        steps, limit = len(demonstration.actions), adapter.env.max_steps
        assert demonstration.rewards.dtype == np.float32 and not demonstration.rewards[:-1].any()
        assert demonstration.rewards[-1] == pytest.approx(1 - 0.9 * steps / limit)
        assert (demonstration.terminated, demonstration.truncated) == (True, False)
        states = demonstration.observations
        if "Seq" not in name and "PutNext" not in name:  # it faces its goal in the end
            x, y, direction = states.pose[-1]
            np.testing.assert_array_equal(np.array([x, y]) + FRONT[direction], states.goal[-1])
            assert (states.goal == states.goal[0]).all()
        if name == "PickUpLoc":
            assert demonstration.actions[-1] == PICKUP and states.carried[-1, 0] > 0
            assert (states.carried[:-1] == 0).all()
    # No level of the training range is passed over but those that are counted as dropped.
    found = [d.seed for d in result.demonstrations]
    first = next(seeds.training_seeds(5))
    assert found == sorted(set(found)) and first <= found[0]
    assert found[-1] - first + 1 == len(found) + result.dropped.total() < seeds.TRAINING_STRIDE


@pytest.mark.parametrize("name", ["GoToObjMazeS4", "GoToObjMazeS7", "GoToObjMazeS4R2Close"])
def test_the_full_view_bot_takes_a_shortest_way(name):
    through_doors = 0
    for demonstration in collected(name).demonstrations:
        env = reset(name, demonstration.seed)
        start = tuple(map(int, env.agent_pos))
        lengths = slow_path_lengths(env.grid, start)
        moves = int((demonstration.actions == FORWARD).sum())
        # The target is faced, not entered.
        assert moves == lengths[tuple(demonstration.observations.goal[0])] - 1
        toggles = int((demonstration.actions == TOGGLE).sum())
        assert toggles == 0 or name.endswith("Close")
        through_doors += toggles
    assert through_doors > 0 or not name.endswith("Close")


def doors(env) -> list[Door]:
    return [cell for cell in env.grid.grid if isinstance(cell, Door)]


def test_a_search_leaves_the_doors_as_they_were():
    opened = 0
    for seed in range(10):
        env = reset("GoToObjMazeS4R2Close", seed)
        bot, action, over = FullViewBot(env), None, False
        while not over:
            before = [(door.is_open, door.is_locked) for door in doors(env)]
            action = int(bot.replan(action))
            assert [(door.is_open, door.is_locked) for door in doors(env)] == before
            _, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            after = [(door.is_open, door.is_locked) for door in doors(env)]
            opened += after != before
            assert after == before or action == TOGGLE
    assert opened > 3


def test_a_search_that_fails_leaves_the_doors_as_they_were():
    env = reset("GoToObjMazeS4R2Close", 0)
    bot = FullViewBot(env)

    def refuse(position, cell):
        if isinstance(cell, Door):
            assert not cell.is_open  # what is accepted is asked of the doors as they are
            raise LookupError
        return False

    start = [(*map(int, env.agent_pos), *map(int, env.dir_vec))]
    with pytest.raises(LookupError):
        bot._breadth_first_search(start, refuse, ignore_blockers=True)
    assert doors(env) and not any(door.is_open for door in doors(env))


def test_locked_doors_are_left_to_the_exploring_bot():
    assert type(demonstrations.make_bot(reset("BabyAI-UnlockLocal-v0", 0))) is BabyAIBot
    assert type(demonstrations.make_bot(reset("GoToObjMazeS4R2Close", 0))) is FullViewBot


def test_demonstrations_depend_on_the_training_seed_alone():
    level = levels.find_level("GoToLocalS7N5")
    reported = []
    more = demonstrations.collect(level, 7, seed=5, progress=reported.append).demonstrations
    again = demonstrations.collect(level, 3, seed=5).demonstrations
    other = demonstrations.collect(level, 3, seed=6).demonstrations
    assert reported == [1, 2, 3, 4, 5, 6, 7]
    assert len(more) == 7 and len(again) == 3
    for a, b in zip(more, again, strict=False):
        jax.tree.map(np.testing.assert_array_equal, a, b)
    assert not {d.seed for d in more} & {d.seed for d in other}


def test_a_level_that_the_bot_cannot_solve_is_given_up(monkeypatch):
    class Lost:
        stack = ()

        def replan(self, action_taken):
            raise AssertionError("unreachable\nobject")

    monkeypatch.setattr(demonstrations, "make_bot", lambda env: Lost())
    with pytest.raises(UserError, match="the bot cannot solve this level") as raised:
        demonstrations.collect(levels.find_level("GoToLocalS7N5"), 1, seed=0)
    assert "\n" not in str(raised.value)
    with pytest.raises(UserError, match="at least one demonstration"):
        demonstrations.collect(levels.find_level("GoToLocalS7N5"), 0, seed=0)


def test_a_bot_that_gives_up_or_runs_out_of_time_has_failed(monkeypatch):
    adapter = BabyAIAdapter(levels.find_level("GoToLocalS7N5"))
    end, drop = 6, DROP  # dropping nothing never does anything
    for constant in (end, drop):

        class Stubborn:
            stack = ()

            def replan(self, action_taken, constant=constant):
                return constant

        monkeypatch.setattr(demonstrations, "make_bot", lambda env, bot=Stubborn: bot())
        dropped = Counter()
        assert demonstrations.demonstrate(adapter, 0, dropped) is None
        assert dropped == {FAILED: 1}
        assert adapter.env.step_count == (0 if constant == end else adapter.env.max_steps)


def test_an_episode_that_ends_at_another_match_is_dropped(monkeypatch):
    adapter = BabyAIAdapter(levels.find_level("GoToLocalS7N5"))
    monkeypatch.setattr(observations, "nearest_goal", lambda env: (0, 0))
    dropped = Counter()
    assert demonstrations.demonstrate(adapter, 0, dropped) is None
    assert dropped == {OTHER_GOAL: 1}
