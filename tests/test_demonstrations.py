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
from leapjax.domains.babyai.bot import FullViewBot
from leapjax.domains.babyai.demonstrations import FAILED, OTHER_GOAL
from leapjax.errors import UserError
from tests.dynamics import FRONT
from tests.oracles import assert_same_observation, slow_path_lengths

FORWARD, PICKUP, DROP, TOGGLE, END = 2, 3, 4, 5, 6
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
def collect_level(name: str) -> Collection:
    return demonstrations.collect(levels.find_level(name), COUNTS[name], seed=5)


def reset(name: str, seed: int):
    env = levels.make_environment(levels.find_level(name))
    with levels.silenced():
        env.reset(seed=seed)
    return env


@pytest.mark.parametrize("name", COUNTS)
def test_demonstrations_can_be_replayed_from_their_seeds(name):
    adapter = BabyAIAdapter(levels.find_level(name))
    collected = collect_level(name).demonstrations
    assert len(collected) == COUNTS[name]
    for demonstration in collected:
        states, count = demonstration.observations, len(demonstration.actions)
        assert len(states.pose) == count + 1
        moments = [jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in range(count + 1)]
        assert_same_observation(adapter.reset(demonstration.seed), moments[0])
        for index, action in enumerate(demonstration.actions.tolist()):
            transition = adapter.step(action)
            assert_same_observation(transition.observation, moments[index + 1])
            assert np.float32(transition.reward) == demonstration.rewards[index]
            assert transition.success == transition.terminated == (index == count - 1)
        assert demonstration.rewards.dtype == np.float32 and not demonstration.rewards[:-1].any()
        assert (demonstration.terminated, demonstration.truncated) == (True, False)
        if "Seq" not in name and "PutNext" not in name:  # the agent faces its goal at the end
            x, y, direction = states.pose[-1]
            np.testing.assert_array_equal(np.array([x, y]) + FRONT[direction], states.goal[-1])
            assert (states.goal == states.goal[0]).all()
        if name == "PickUpLoc":
            assert demonstration.actions[-1] == PICKUP and states.carried[-1, 0] > 0
            assert (states.carried[:-1] == 0).all()
    # Only levels that are counted as dropped are skipped in the training range.
    seen, start = [d.seed for d in collected], next(seeds.training_seeds(5))
    assert seen == sorted(set(seen)) and start <= seen[0]
    passed = seen[-1] - start + 1
    assert passed == len(seen) + collect_level(name).dropped.total() < seeds.TRAINING_STRIDE


@pytest.mark.parametrize("name", ["GoToObjMazeS4", "GoToObjMazeS7", "GoToObjMazeS4R2Close"])
def test_full_view_bot_takes_shortest_paths(name):
    toggles = 0
    for demonstration in collect_level(name).demonstrations:
        env = reset(name, demonstration.seed)
        lengths = slow_path_lengths(env.grid, tuple(map(int, env.agent_pos)))
        moves = int((demonstration.actions == FORWARD).sum())
        # The agent stops in front of the target.
        assert moves == lengths[tuple(demonstration.observations.goal[0])] - 1
        toggles += int((demonstration.actions == TOGGLE).sum())
    assert (toggles > 0) == name.endswith("Close")


def read_doors(env) -> list[tuple[bool, bool]]:
    return [(cell.is_open, cell.is_locked) for cell in env.grid.grid if isinstance(cell, Door)]


def test_search_restores_doors_even_if_it_fails():
    for seed in range(10):
        env = reset("GoToObjMazeS4R2Close", seed)
        bot, action, over = FullViewBot(env), None, False
        while not over:
            before = read_doors(env)
            action = int(bot.replan(action))
            assert read_doors(env) == before
            _, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            assert read_doors(env) == before or action == TOGGLE

    def reject(position, cell):
        if isinstance(cell, Door):
            assert not cell.is_open  # the callback must see the real state of doors
            raise LookupError
        return False

    env = reset("GoToObjMazeS4R2Close", 0)
    start = [(*map(int, env.agent_pos), *map(int, env.dir_vec))]
    with pytest.raises(LookupError):
        FullViewBot(env)._breadth_first_search(start, reject, ignore_blockers=True)
    assert read_doors(env) and not any(is_open for is_open, _ in read_doors(env))


@pytest.mark.parametrize(
    ("name", "most"),
    [("BabyAI-KeyCorridor-v0", 0.6), ("BabyAI-UnlockPickup-v0", 1.0),
     ("BabyAI-PutNextS5N1-v0", 1.0)],
)  # fmt: skip
def test_full_view_bot_takes_shorter_paths_through_locked_doors(name, most):
    """MiniGrid's bot explores until it finds the key. Without locked doors both may agree."""
    seen, explored = [], []
    for seed in range(8):
        for kind, lengths in ((FullViewBot, seen), (BabyAIBot, explored)):
            env, action, over = reset(name, seed), None, False
            bot = kind(env)
            while not over:
                action = int(bot.replan(action))
                _, reward, terminated, truncated, _ = env.step(action)
                over = terminated or truncated
            assert terminated and reward > 0
            lengths.append(env.step_count)
    assert sum(seen) <= most * sum(explored)


@pytest.mark.parametrize("name", ["BabyAI-UnlockToUnlock-v0", "BabyAI-BlockedUnlockPickup-v0",
                                  "BabyAI-PutNextS5N2Carrying-v0"])  # fmt: skip
def test_bot_handles_keys_behind_locked_doors_and_objects_in_hand(name):
    level = levels.find_level(name)
    collected = demonstrations.collect(level, 8, seed=0)
    assert collected.dropped[FAILED] <= 2
    doors_opened = [(d.actions == TOGGLE).sum() for d in collected.demonstrations]
    assert min(doors_opened) >= {"BabyAI-UnlockToUnlock-v0": 2}.get(name, 0)


def test_demonstrations_depend_only_on_the_training_seed():
    level, reported = levels.find_level("GoToLocalS7N5"), []
    more = demonstrations.collect(level, 7, seed=5, progress=reported.append).demonstrations
    again, other = (demonstrations.collect(level, 3, seed=s).demonstrations for s in (5, 6))
    assert reported == [1, 2, 3, 4, 5, 6, 7]
    for a, b in zip(more[:3], again, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)
    assert not {d.seed for d in more} & {d.seed for d in other}


class Stubborn:
    """A bot that repeats its action, or fails without an action."""

    stack = ()

    def __init__(self, action):
        self.action = action

    def replan(self, action_taken):
        if self.action is None:
            raise AssertionError("unreachable\nobject")
        return self.action


def test_unsolvable_levels_raise_an_error(monkeypatch):
    monkeypatch.setattr(demonstrations, "FullViewBot", lambda env: Stubborn(None))
    with pytest.raises(UserError, match="the bot cannot solve this level") as raised:
        demonstrations.collect(levels.find_level("GoToLocalS7N5"), 1, seed=0)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("action", [END, DROP])  # DROP with empty hands has no effect
def test_giving_up_or_running_out_of_time_counts_as_failure(monkeypatch, action):
    adapter, dropped = BabyAIAdapter(levels.find_level("GoToLocalS7N5")), Counter()
    monkeypatch.setattr(demonstrations, "FullViewBot", lambda env: Stubborn(action))
    assert demonstrations.demonstrate(adapter, 0, dropped) is None
    assert dropped == {FAILED: 1}
    assert adapter.env.step_count == (0 if action == END else adapter.env.max_steps)


def test_episodes_that_end_at_another_match_are_dropped(monkeypatch):
    adapter = BabyAIAdapter(levels.find_level("GoToLocalS7N5"))
    monkeypatch.setattr(observations, "nearest_goal", lambda env: (0, 0))
    dropped = Counter()
    assert demonstrations.demonstrate(adapter, 0, dropped) is None
    assert dropped == {OTHER_GOAL: 1}
