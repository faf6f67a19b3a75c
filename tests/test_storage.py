import json
import shutil

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_dataset import parse_dataset_id

from leapjax.data import storage
from leapjax.data.demonstrations import Collection, Demonstration
from leapjax.envs import levels
from leapjax.errors import UserError
from leapjax.types import Observation
from tests.oracles import assert_same_observation

LEVEL = levels.find_level("GoToLocalS7N5")
SIDE = 7
NAME = "leapjax/GoToLocalS7N5/test-v1"


def file_of(folder, name: str = NAME):
    return folder / name / "data" / "main_data.hdf5"


def refused(name: str = NAME, level=LEVEL, side: int = SIDE) -> str:
    """The one line with which a data set is refused."""
    with pytest.raises(UserError) as raised:
        storage.load(name, level, side)
    message = str(raised.value)
    assert message and "\n" not in message
    assert name in message
    return message


def assert_same(loaded: list[Demonstration], expected: list[Demonstration]) -> None:
    assert len(loaded) == len(expected)
    for a, b in zip(loaded, expected, strict=True):
        assert_same_observation(a.observations, b.observations)
        np.testing.assert_array_equal(a.actions, b.actions)
        assert a.seed == b.seed
        types = [x.dtype for x in (*a.observations, a.actions)]
        assert types == [x.dtype for x in (*b.observations, b.actions)]


@pytest.fixture
def saved(local_demonstrations) -> list[Demonstration]:
    storage.save(NAME, Collection(local_demonstrations), "for a test")
    return local_demonstrations


def test_what_is_saved_is_loaded(saved):
    assert_same(storage.load(NAME, LEVEL, SIDE), saved)


def test_minari_itself_can_read_it(saved):
    assert list(minari.list_local_datasets()) == [NAME]
    dataset = minari.load_dataset(NAME)
    assert dataset.total_episodes == len(saved)
    assert dataset.total_steps == sum(len(d.actions) for d in saved)
    for episode, demonstration in zip(dataset.iterate_episodes(), saved, strict=True):
        assert episode.rewards.sum() == episode.rewards[-1] == 1.0
        assert episode.terminations[-1] and not episode.terminations[:-1].any()
        np.testing.assert_array_equal(episode.actions, demonstration.actions)
        assert dataset.observation_space.contains(
            {field: values[0] for field, values in episode.observations.items()}
        )


def test_grids_of_any_size_are_stored_without_loss():
    # Minari takes byte arrays of 32 x 32 and more for pictures, unless it is told.
    rng = np.random.default_rng(0)
    side, steps = 40, 3
    grid = np.stack([rng.integers(0, h, (steps + 1, side, side)) for h in (11, 6, 4)], axis=-1)
    demonstration = Demonstration(
        Observation(
            grid.astype(np.uint8),
            np.zeros((steps + 1, 3), np.int32),
            np.zeros((steps + 1, 2), np.int32),
            np.full((steps + 1, 2), -1, np.int32),
            np.ones((steps + 1, LEVEL.words), np.int32),
        ),
        np.zeros(steps, np.int32),
        seed=7,
    )
    storage.save(NAME, Collection([demonstration]), "large")
    assert_same(storage.load(NAME, LEVEL, side), [demonstration])


def test_saving_again_replaces(saved):
    storage.save(NAME, Collection(saved[3:]), "fewer")
    assert_same(storage.load(NAME, LEVEL, SIDE), saved[3:])


def test_data_sets_live_side_by_side(saved):
    storage.save("leapjax/GoToLocalS7N5/other-v1", Collection(saved[:2]), "another")
    assert_same(storage.load(NAME, LEVEL, SIDE), saved)
    assert_same(storage.load("leapjax/GoToLocalS7N5/other-v1", LEVEL, SIDE), saved[:2])


class Killed(BaseException):
    """What a program that dies in the middle is to its callers."""


@pytest.mark.parametrize("moment", ["minari", "rename"])
def test_a_killed_save_leaves_nothing_under_the_name(
    moment, local_demonstrations, monkeypatch, minari_folder
):
    written = minari.create_dataset_from_buffers

    def die(*args, **kwargs):
        if moment == "minari":
            written(*args, **kwargs)
        raise Killed

    with monkeypatch.context() as patch:
        if moment == "minari":
            patch.setattr(minari, "create_dataset_from_buffers", die)
        else:
            patch.setattr(storage, "_rename_id", die)
        with pytest.raises(Killed):
            storage.save(NAME, Collection(local_demonstrations), "killed")
    assert any(minari_folder.rglob("main_data.hdf5"))  # the scratch folder is left behind
    assert not storage.exists(NAME)
    assert "no Minari data set" in refused()
    storage.save(NAME, Collection(local_demonstrations), "again")
    assert_same(storage.load(NAME, LEVEL, SIDE), local_demonstrations)
    assert list(minari.list_local_datasets()) == [NAME]


def test_a_killed_save_leaves_what_was_there(saved, monkeypatch):
    def die(*args):
        raise Killed

    monkeypatch.setattr(storage, "_rename_id", die)
    with pytest.raises(Killed):
        storage.save(NAME, Collection(saved[:1]), "killed")
    assert_same(storage.load(NAME, LEVEL, SIDE), saved)


def test_exists():
    assert not storage.exists(NAME)


def test_exists_once_saved(saved):
    assert storage.exists(NAME)


@pytest.mark.parametrize("name", ["leapjax/none-v0", "none", "a/b/c/none-v3", "no such name!"])
def test_a_missing_data_set(name):
    assert "no Minari data set" in refused(name)


def test_a_namespace_is_not_a_data_set(saved):
    refused("leapjax/GoToLocalS7N5")


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_file(saved, minari_folder, kept):
    path = file_of(minari_folder)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    assert "cannot be read" in refused()


def test_a_file_of_garbage(saved, minari_folder):
    file_of(minari_folder).write_bytes(b"\x00garbage\n" * 1000)
    assert "cannot be read" in refused()


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "\x00"])
def test_damaged_metadata(saved, minari_folder, text):
    (minari_folder / NAME / "data" / "metadata.json").write_text(text)
    assert "cannot be read" in refused()


@pytest.mark.parametrize("name", ["main_data.hdf5", "metadata.json"])
def test_a_missing_file(saved, minari_folder, name):
    (minari_folder / NAME / "data" / name).unlink()
    assert "cannot be read" in refused()


def test_an_empty_folder(saved, minari_folder):
    shutil.rmtree(minari_folder / NAME / "data")
    assert "cannot be read" in refused()


def test_a_missing_episode(saved, minari_folder):
    with h5py.File(file_of(minari_folder), "r+") as file:
        del file["episode_2"]
    assert "cannot be read" in refused()


@pytest.mark.parametrize("field", ["observations", "actions", "observations/goal"])
def test_a_missing_part_of_an_episode(saved, minari_folder, field):
    with h5py.File(file_of(minari_folder), "r+") as file:
        del file["episode_2"][field]
    refused()


def test_no_episodes(saved, minari_folder):
    path = minari_folder / NAME / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps({**metadata, "total_episodes": 0, "total_steps": 0}))
    assert "no episodes" in refused()


def test_another_level(saved):
    assert "instruction has shape" in refused(level=levels.find_level("PickUpLoc"))


@pytest.mark.parametrize("side", [6, 8])
def test_another_side(saved, side):
    assert "grid has shape" in refused(side=side)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("observations/grid", 11, "grid objects"),
        ("observations/grid", 255, "grid objects"),
        ("observations/pose", 7, "positions"),
        ("observations/pose", -1, "positions"),
        ("observations/carried", 11, "carried objects"),
        ("observations/carried", -1, "carried objects"),
        ("observations/goal", 7, "goals"),
        ("observations/goal", -2, "goals"),
        ("observations/instruction", 100, "instruction"),
        ("observations/instruction", -1, "instruction"),
        ("actions", 6, "actions"),
        ("actions", -1, "actions"),
    ],
)
def test_a_value_out_of_range(saved, minari_folder, field, value, says):
    with h5py.File(file_of(minari_folder), "r+") as file:
        values = file["episode_3"][field]
        values[(0,) * values.ndim] = value
    message = refused()
    assert says in message and "episode 3" in message and str(value) in message


def test_a_direction_out_of_range(saved, minari_folder):
    with h5py.File(file_of(minari_folder), "r+") as file:
        file["episode_0"]["observations/pose"][1, 2] = 4
    assert "directions run from" in refused()


def replace(path, episode: str, field: str, values: np.ndarray) -> None:
    with h5py.File(path, "r+") as file:
        del file[episode][field]
        file[episode][field] = values


@pytest.mark.parametrize("field", ["pose", "grid", "goal", "instruction"])
def test_observations_of_another_length(saved, minari_folder, field):
    values = getattr(saved[0].observations, field)[:-1]
    replace(file_of(minari_folder), "episode_0", f"observations/{field}", values)
    assert f"{field} has shape" in refused()


def test_an_episode_without_actions(saved, minari_folder):
    replace(file_of(minari_folder), "episode_0", "actions", np.zeros(0, np.int64))
    assert "no actions" in refused()


def test_actions_of_64_bits_do_not_wrap_around(saved, minari_folder):
    actions = saved[0].actions.astype(np.int64) + 2**32
    replace(file_of(minari_folder), "episode_0", "actions", actions)
    assert "actions run from" in refused()


def other_data_set(observation_space, observations, action_space, actions, **episode) -> None:
    steps = len(actions)
    minari.create_dataset_from_buffers(
        dataset_id=NAME,
        buffer=[
            EpisodeBuffer(
                id=0,
                observations=observations,
                actions=actions,
                rewards=[0.0] * steps,
                terminations=[False] * steps,
                truncations=[False] * (steps - 1) + [True],
                **episode,
            )
        ],
        observation_space=observation_space,
        action_space=action_space,
        jpeg_encoding=False,
    )


def test_a_data_set_of_plain_arrays():
    other_data_set(
        gym.spaces.Box(-1, 1, (4,), np.float32),
        np.zeros((3, 4), np.float32),
        gym.spaces.Discrete(2),
        [0, 1],
    )
    assert "no observation 'grid'" in refused()


def test_a_data_set_of_minigrids_own_observations():
    space = gym.spaces.Dict(
        {
            "image": gym.spaces.Box(0, 255, (7, 7, 3), np.uint8),
            "direction": gym.spaces.Discrete(4),
            "mission": gym.spaces.Text(20, charset="abcdefghijklmnopqrstuvwxyz "),
        }
    )
    states = {
        "image": np.zeros((3, 7, 7, 3), np.uint8),
        "direction": np.zeros(3, np.int64),
        "mission": ["go to the ball"] * 3,
    }
    other_data_set(space, states, gym.spaces.Discrete(7), [0, 1])
    assert "no observation 'grid'" in refused()


def test_a_users_data_set_without_seeds(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    other_data_set(
        storage.observation_space(SIDE, LEVEL.words),
        demonstration.observations._asdict(),
        gym.spaces.Discrete(6),
        list(demonstration.actions),
    )
    expected = demonstration._replace(seed=storage.UNKNOWN_SEED)
    assert_same(storage.load(NAME, LEVEL, SIDE), [expected])


def test_fields_of_text_instead_of_numbers(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    space = storage.observation_space(SIDE, LEVEL.words)
    space["instruction"] = gym.spaces.Text(20, charset="abcdefghijklmnopqrstuvwxyz ")
    states = demonstration.observations._asdict()
    states["instruction"] = ["go to the red ball"] * len(states["pose"])
    other_data_set(space, states, gym.spaces.Discrete(6), list(demonstration.actions))
    refused()


def test_continuous_actions(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    steps = len(demonstration.actions)
    other_data_set(
        storage.observation_space(SIDE, LEVEL.words),
        demonstration.observations._asdict(),
        gym.spaces.Box(0, 1, (2,), np.float32),
        list(np.full((steps, 2), 0.5, np.float32)),
    )
    refused()


def test_numbers_that_wrap_around_are_out_of_range(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    space = storage.observation_space(SIDE, LEVEL.words)
    space["grid"] = gym.spaces.Box(0, 1000, (SIDE, SIDE, 3), np.int32)
    states = demonstration.observations._asdict()
    states["grid"] = states["grid"].astype(np.int32) + 256
    other_data_set(space, states, gym.spaces.Discrete(6), list(demonstration.actions))
    assert "grid objects" in refused()


def test_numbers_that_are_not_whole(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    space = storage.observation_space(SIDE, LEVEL.words)
    space["grid"] = gym.spaces.Box(0, 1, (SIDE, SIDE, 3), np.float32)
    states = demonstration.observations._asdict()
    states["grid"] = states["grid"] / np.float32(255)  # scaled, as pictures often are
    other_data_set(space, states, gym.spaces.Discrete(6), list(demonstration.actions))
    refused()


def test_every_level_has_a_cache_of_its_own():
    known = [levels.find_level(name) for name in (*levels.LEVELS, *levels.registered_levels())]
    ids = [storage.dataset_id(level, 500, 0) for level in known]
    shared = {ids[i] for i in range(len(ids)) if ids[i] in ids[:i]}
    assert not shared


def test_every_count_and_seed_has_a_cache_of_its_own():
    ids = {storage.dataset_id(LEVEL, count, seed) for count in (5, 50) for seed in (0, 1)}
    assert len(ids) == 4
    for name in ids:
        namespace, short, version = parse_dataset_id(name)
        assert namespace and short and version is not None
