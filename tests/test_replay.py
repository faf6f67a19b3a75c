"""Data sets of MiniGrid's own observations, as Minari's collector writes them."""

import string

import gymnasium as gym
import h5py
import jax
import pytest
from gymnasium import spaces
from minari import DataCollector
from minigrid.utils.baby_ai_bot import BabyAIBot
from minigrid.wrappers import FullyObsWrapper

from experiments import babyai
from leapjax.data import storage
from leapjax.domains.babyai import demonstrations, levels, replay
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.settings import Settings
from leapjax.errors import UserError
from leapjax.running import command_line
from tests.oracles import assert_same_observation
from tests.programs import TOY, only_long
from tests.test_storage import file_of

LEVEL = "BabyAI-GoToLocal-v0"
DOMAIN = BABYAI.make(LEVEL, Settings())
LEFT, DONE = 0, 6
PARTIAL = "minigrid/BabyAI-GoToLocal/optimal-v0"


def record(name, wrap=None, episodes=5, level=LEVEL, spoil=None, first=1000):
    """Records a data set of MiniGrid's bot; the action `spoil`, if given, spoils episode 1."""
    with levels.silenced():
        env = gym.make(level) if wrap is None else wrap(gym.make(level))
    words = spaces.Text(200, charset=string.printable)
    space = spaces.Dict({**env.observation_space.spaces, "mission": words})
    collector = DataCollector(env, observation_space=space, jpeg_encoding=False)
    for episode in range(episodes):
        with levels.silenced():
            collector.reset(seed=first + episode)
        bot, action, over = BabyAIBot(env.unwrapped), None, False
        if episode == 1 and spoil is not None:
            collector.step(spoil)
            for _ in range(2):  # then the episode is cut off
                collector.step(LEFT)
            continue
        while not over:
            action = int(bot.replan(action))
            _, _, terminated, truncated, _ = collector.step(action)
            over = terminated or truncated
    collector.create_dataset(name, algorithm_name="BabyAIBot")
    collector.close()
    return name


@pytest.mark.parametrize(
    ("wrap", "level"),
    [(None, LEVEL), (FullyObsWrapper, LEVEL), (None, "BabyAI-GoToLocalS7N5-v0")],  # view is 7x7
)
def test_recordings_are_replayed_with_full_observations(wrap, level):
    name, domain = "minigrid/some/optimal-v0", BABYAI.make(level, Settings())
    collection = storage.load(record(name, wrap, level=level), domain)
    assert not collection.dropped and len(collection.demonstrations) == 5
    adapter = demonstrations.BabyAIAdapter(levels.find_level(level))
    for number, found in enumerate(collection.demonstrations):
        assert found.seed == 1000 + number and found.terminated and found.rewards[-1] > 0
        state = adapter.reset(found.seed)
        for step, action in enumerate([*found.actions, None]):
            assert_same_observation(jax.tree.map(lambda x, i=step: x[i], found.observations), state)
            if action is not None:
                state = adapter.step(int(action)).observation
    assert [d.seed for d in storage.load(name, domain, most=2).demonstrations] == [1000, 1001]


@pytest.mark.parametrize(
    ("options", "reason", "seeds"),
    [
        ({"spoil": DONE}, replay.DONE, [1000, 1002, 1003, 1004]),
        ({"spoil": LEFT}, replay.FAILED, [1000, 1002, 1003, 1004]),
        # It ends at another match, so the observed goal would teach the wrong target.
        ({"episodes": 2, "first": 1008}, replay.OTHER_GOAL, [1008]),
    ],
)
def test_unusable_episodes_are_dropped_and_counted(options, reason, seeds):
    collection = storage.load(record(PARTIAL, **options), DOMAIN)
    assert collection.dropped == {reason: 1}
    assert [d.seed for d in collection.demonstrations] == seeds


def test_inconsistent_episodes_are_dropped_and_counted():
    name = record(PARTIAL, episodes=6)
    with h5py.File(file_of(storage.find_datasets_folder(), name), "a") as file:
        file["episode_1/observations/image"][1, 3, 3, 0] += 1  # a state that never occurred
        file["episode_2"].attrs["seed"] = 5  # the seed of another level
        file["episode_3/rewards"][-1] = 0.123
        del file["episode_4"].attrs["seed"]
        shorter = file["episode_5/observations/image"][:-1]
        del file["episode_5/observations/image"]
        file["episode_5/observations/image"] = shorter
    found = storage.load(name, DOMAIN)
    assert found.dropped == {replay.DIFFERENT: 3, replay.NO_SEED: 1, replay.INCOMPLETE: 1}
    assert [d.seed for d in found.demonstrations] == [1000]
    with h5py.File(file_of(storage.find_datasets_folder(), name), "a") as file:
        file["episode_0/observations/image"][0] = 0
    with pytest.raises(UserError, match="can be used, only 4 that go otherwise"):
        storage.load(name, DOMAIN)


def test_level_is_read_from_the_data_and_must_match():
    name = record(PARTIAL, episodes=1)
    (chosen,) = command_line.parse("babyai", ["--demonstrations", name])
    assert chosen.level == LEVEL and chosen.demonstrations == name
    with pytest.raises(
        UserError, match=f"is of {LEVEL}, not of GoToLocalS7N5: use --level {LEVEL}"
    ):
        command_line.parse("babyai", ["--demonstrations", name, "--level", "GoToLocalS7N5"])


def test_program_runs_on_recorded_data(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    name = record(PARTIAL, spoil=DONE)
    assert babyai.main([*TOY, "--demonstrations", name]) == 2
    assert f"4 episodes that can be used (1 {replay.DONE}), fewer than 6" in (
        " ".join(capsys.readouterr().err.split())
    )
    few = ["--demos", "4", "--steps", "0", "--method", "random"]
    assert babyai.main([*"--episodes 2 --no-pictures".split(), *few, "--demonstrations", name]) == 0
    assert f"dropped: 1 {replay.DONE}" in " ".join(capsys.readouterr().out.split())
    overlap = ["--demonstrations", name, "--test-seed", "1000"]
    assert babyai.main([*"--episodes 2 --no-pictures".split(), *few, *overlap]) == 2
    assert "both a demonstration" in " ".join(capsys.readouterr().err.split())


@only_long
def test_many_levels_can_be_replayed():
    for level in ("BabyAI-GoToSeqS5R2-v0", "BabyAI-PickupLoc-v0", "BabyAI-UnlockLocal-v0"):
        name = record(f"minigrid/{level}/optimal-v0", episodes=20, level=level)
        found = storage.load(name, BABYAI.make(level, Settings()))
        assert len(found.demonstrations) + found.dropped.get(replay.OTHER_GOAL, 0) == 20
