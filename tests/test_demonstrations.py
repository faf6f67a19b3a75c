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
from leapjax.domains.babyai.adapter import END, BabyAIAdapter
from leapjax.domains.babyai.demonstrations import FAILED, OTHER_GOAL, FullViewBot
from leapjax.errors import UserError
from tests.oracles import assert_same_observation, slow_path_lengths

FORWARD, DROP, TOGGLE = 2, 4, 5
FRONT = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
COUNTS = {
    "GoToLocalS8N7": 20,
    "GoToObjMazeS4": 10,
    "GoToObjMazeS7": 2,
    "GoToObjMazeS4R2Close": 15,
    "PickUpLoc": 15,
    "GoToSeqS5R2": 8,
    "BabyAI-PutNextLocal-v0": 5,
    "BabyAI-UnlockLocal-v0": 5,
}
SMALLEST = levels.find_level("GoToLocalS7N5")


@functools.cache
def collected(name: str) -> Collection:
    return demonstrations.collect(levels.find_level(name), COUNTS[name], seed=5)


def reset(name: str, seed: int):
    env = levels.make_environment(levels.find_level(name))
    with levels.silenced():
        env.reset(seed=seed)
    return env


@pytest.mark.parametrize("name", COUNTS)
def test_a_demonstration_can_be_replayed_from_its_seed(name):
    adapter, result = BabyAIAdapter(levels.find_level(name)), collected(name)
    assert len(result.demonstrations) == COUNTS[name]
    for demonstration in result.demonstrations:
        states, steps = demonstration.observations, len(demonstration.actions)
        seen = [adapter.reset(demonstration.seed)]
        for reward, action in zip(demonstration.rewards, demonstration.actions, strict=True):
            transition = adapter.step(int(action))
            seen.append(transition.observation)
            assert np.float32(transition.reward) == reward
            assert transition.success == transition.terminated == (len(seen) == steps + 1)
        assert_same_observation(jax.tree.map(lambda *leaves: np.stack(leaves), *seen), states)
        assert demonstration.rewards.dtype == np.float32 and not demonstration.rewards[:-1].any()
        last = 1 - 0.9 * steps / adapter.env.max_steps
        assert demonstration.rewards[-1] == pytest.approx(last)
        assert (demonstration.terminated, demonstration.truncated) == (True, False)
        if "Seq" not in name and "PutNext" not in name:  # it faces its goal in the end
            x, y, direction = states.pose[-1]
            np.testing.assert_array_equal(np.array([x, y]) + FRONT[direction], states.goal[-1])
    # No level of the training range is passed over but those that are counted as dropped.
    found, first = [d.seed for d in result.demonstrations], next(seeds.training_seeds(5))
    assert found == sorted(set(found)) and first <= found[0]
    assert found[-1] - first + 1 == len(found) + result.dropped.total() < seeds.TRAINING_STRIDE


@pytest.mark.parametrize("name", ["GoToObjMazeS4", "GoToObjMazeS7", "GoToObjMazeS4R2Close"])
def test_the_full_view_bot_takes_a_shortest_way(name):
    toggles = 0
    for demonstration in collected(name).demonstrations:
        env = reset(name, demonstration.seed)
        lengths = slow_path_lengths(env.grid, tuple(map(int, env.agent_pos)))
        # The target is faced, not entered.
        moves = int((demonstration.actions == FORWARD).sum())
        assert moves == lengths[tuple(demonstration.observations.goal[0])] - 1
        toggles += int((demonstration.actions == TOGGLE).sum())
    assert (toggles > 0) == name.endswith("Close")


def doors(env) -> list[tuple[bool, bool]]:
    cells = (cell for cell in env.grid.grid if isinstance(cell, Door))
    return [(door.is_open, door.is_locked) for door in cells]


def test_a_search_leaves_the_doors_as_they_were():
    opened = 0
    for seed in range(10):
        env = reset("GoToObjMazeS4R2Close", seed)
        bot, action, over = FullViewBot(env), None, False
        while not over:
            before = doors(env)
            action = int(bot.replan(action))
            assert doors(env) == before
            _, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            opened += doors(env) != before
    assert opened > 3


def test_a_search_that_fails_leaves_the_doors_as_they_were():
    env = reset("GoToObjMazeS4R2Close", 0)

    def refuse(position, cell):
        if isinstance(cell, Door):
            assert not cell.is_open  # what is accepted is asked of the doors as they are
            raise LookupError
        return False

    start = [(*map(int, env.agent_pos), *map(int, env.dir_vec))]
    with pytest.raises(LookupError):
        FullViewBot(env)._breadth_first_search(start, refuse, ignore_blockers=True)
    assert doors(env) and not any(is_open for is_open, _ in doors(env))


def test_locked_doors_are_left_to_the_exploring_bot():
    assert type(demonstrations.make_bot(reset("BabyAI-UnlockLocal-v0", 0))) is BabyAIBot
    assert type(demonstrations.make_bot(reset("GoToObjMazeS4R2Close", 0))) is FullViewBot


def test_demonstrations_depend_on_the_training_seed_alone():
    reported = []
    more = demonstrations.collect(SMALLEST, 7, 5, progress=reported.append).demonstrations
    again, other = (demonstrations.collect(SMALLEST, 3, seed).demonstrations for seed in (5, 6))
    assert reported == [1, 2, 3, 4, 5, 6, 7]
    assert len(more) == 7 and len(again) == 3
    jax.tree.map(np.testing.assert_array_equal, more[:3], again)
    assert not {d.seed for d in more} & {d.seed for d in other}


class Stub:
    """A bot that takes one action, or fails."""

    stack = ()

    def __init__(self, action=None):
        self.action = action

    def replan(self, action_taken):
        assert self.action is not None, "unreachable\nobject"
        return self.action


def test_a_level_that_the_bot_cannot_solve_is_given_up(monkeypatch):
    monkeypatch.setattr(demonstrations, "make_bot", lambda env: Stub())
    with pytest.raises(UserError, match="the bot cannot solve this level") as raised:
        demonstrations.collect(SMALLEST, 1, seed=0)
    assert "\n" not in str(raised.value)
    with pytest.raises(UserError, match="at least one demonstration"):
        demonstrations.collect(SMALLEST, 0, seed=0)


@pytest.mark.parametrize("action", [END, DROP])  # dropping nothing never does anything
def test_a_bot_that_gives_up_or_runs_out_of_time_has_failed(monkeypatch, action):
    monkeypatch.setattr(demonstrations, "make_bot", lambda env: Stub(action))
    adapter, dropped = BabyAIAdapter(SMALLEST), Counter()
    assert demonstrations.demonstrate(adapter, 0, dropped) is None
    assert dropped == {FAILED: 1}
    assert adapter.env.step_count == (0 if action == END else adapter.env.max_steps)


def test_an_episode_that_ends_at_another_match_is_dropped(monkeypatch):
    monkeypatch.setattr(observations, "nearest_goal", lambda env: (0, 0))
    dropped = Counter()
    assert demonstrations.demonstrate(BabyAIAdapter(SMALLEST), 0, dropped) is None
    assert dropped == {OTHER_GOAL: 1}
