import io
import json
import math
import os
import shutil
import warnings
import zlib
from concurrent import futures
from pathlib import Path

import gymnasium as gym
import h5py
import jax
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from PIL import Image

from leapjax import files
from leapjax.data import storage
from leapjax.data.storage import writing
from leapjax.domain import Collection, Domain
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.settings import Settings
from leapjax.errors import UserError
from leapjax.types import Demonstration
from tests import toy

LEVEL = BABYAI.make("GoToLocalS7N5", Settings())
NAME = "leapjax/GoToLocalS7N5/test-v1"


def file_of(folder, name: str = NAME):
    return folder / name / "data" / "main_data.hdf5"


def save(demonstrations: list[Demonstration], name: str = NAME, domain: Domain = LEVEL) -> None:
    storage.save(name, Collection(demonstrations, {}), domain, "for a test")


def load_error(name: str = NAME, domain: Domain = LEVEL) -> str:
    """Returns the error message of one line with which a data set fails to load."""
    with pytest.raises(UserError) as raised:
        storage.load(name, domain)
    message = str(raised.value)
    assert message and "\n" not in message
    assert name in message
    return message


def assert_same(loaded: list[Demonstration], expected: list[Demonstration]) -> None:
    assert len(loaded) == len(expected)
    for a, b in zip(loaded, expected, strict=True):
        assert jax.tree.structure(a) == jax.tree.structure(b)
        jax.tree.map(np.testing.assert_array_equal, a, b)
        arrays = [jax.tree.leaves((d.observations, d.actions, d.rewards)) for d in (a, b)]
        assert [x.dtype for x in arrays[0]] == [x.dtype for x in arrays[1]]


@pytest.fixture
def saved(local_demonstrations) -> list[Demonstration]:
    save(local_demonstrations)
    return local_demonstrations


def test_saved_demonstrations_are_loaded_and_replaced(saved):
    rng = np.random.default_rng(0)
    endings = [(True, False), (False, True), (True, True), (False, False)]
    changed = [
        d._replace(
            rewards=rng.normal(size=len(d.actions)).astype(np.float32), terminated=a, truncated=b
        )
        for d, (a, b) in zip(saved, endings, strict=False)
    ]
    save(changed, "leapjax/GoToLocalS7N5/other-v1")
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)
    assert_same(storage.load("leapjax/GoToLocalS7N5/other-v1", LEVEL).demonstrations, changed)
    save(saved[3:])
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved[3:])


def test_minari_reads_saved_data_sets(saved):
    assert list(minari.list_local_datasets()) == [NAME]
    dataset = minari.load_dataset(NAME)
    assert dataset.total_episodes == len(saved)
    assert dataset.total_steps == sum(len(d.actions) for d in saved)
    for episode, demonstration in zip(dataset.iterate_episodes(), saved, strict=True):
        np.testing.assert_array_equal(episode.rewards, demonstration.rewards)
        np.testing.assert_array_equal(episode.actions, demonstration.actions)
        assert np.flatnonzero(episode.terminations).tolist() == [len(episode.actions) - 1]
        assert dataset.observation_space.contains(
            {field: values[0] for field, values in episode.observations.items()}
        )


def domain_of(blank) -> Domain:
    """Makes a domain whose observations have the structure of `blank`."""
    return toy.DOMAIN._replace(blank=blank)


ARRAY = np.zeros(4, np.float32)
FIELDS = {"place": np.zeros((2, 3), np.float32), "lamps": np.zeros(2, np.uint8)}
NESTED = {"own": {"count": np.zeros((), np.int32)}, "picture": np.zeros((40, 40, 3), np.uint8)}


def make_demonstration(blank) -> Demonstration:
    rng = np.random.default_rng(0)
    states = jax.tree.map(lambda x: (100 * rng.random((4, *x.shape))).astype(x.dtype), blank)
    rewards = rng.normal(size=3).astype(np.float32)
    actions, unknown = np.array([0, 1, 1], np.int32), storage.UNKNOWN_SEED
    return Demonstration(states, actions, rewards, True, False, unknown)


@pytest.mark.parametrize("blank", [ARRAY, FIELDS, NESTED], ids=["array", "fields", "nested"])
def test_observations_of_any_structure_are_saved(blank):
    demonstrations = [make_demonstration(blank)] * 2
    save(demonstrations, domain=domain_of(blank))
    assert_same(storage.load(NAME, domain_of(blank)).demonstrations, demonstrations)


def test_observations_of_another_domain_raise_an_error(minari_folder):
    def replace_values(field, values):
        with h5py.File(file_of(minari_folder), "r+") as file:
            edit(field, lambda before: values, "episode_0")(file)

    save([make_demonstration(ARRAY)], domain=domain_of(ARRAY))
    assert "no observation 'place'" in load_error(domain=domain_of(FIELDS))
    assert "observations has shape (4, 4)" in load_error(domain=domain_of(np.zeros(5, np.float32)))
    assert "must be integers" in load_error(domain=domain_of(np.zeros(4, np.int32)))
    replace_values("observations", np.full((4, 4), np.nan))
    assert "not finite" in load_error(domain=domain_of(ARRAY))
    save([make_demonstration(FIELDS)], domain=domain_of(FIELDS))
    assert "must be numbers" in load_error(domain=domain_of(ARRAY))
    replace_values("observations/lamps", np.full((4, 2), 256))
    assert "do not fit uint8" in load_error(domain=domain_of(FIELDS))


def test_data_sets_of_an_earlier_version_raise_an_error(saved):
    name = "leapjax/GoToLocalS7N5/bot-5-seed0-v1"
    assert storage.name_dataset(LEVEL, 5, 0) == name.replace("v1", "v2")
    save(saved, name)
    assert "earlier version" in load_error(name)
    save(saved, name.replace("v1", "v2"))
    assert_same(storage.load(name.replace("v1", "v2"), LEVEL).demonstrations, saved)


class Killed(BaseException):
    """Simulates that the system kills the program."""


def kill_save(patched, name, calls, demonstrations):
    """Saves, and is killed in call number `calls` of a method."""
    method, made_calls = getattr(patched, name), []

    def raise_killed(*args, **kwargs):
        made_calls.append(args)
        if len(made_calls) == calls:
            raise Killed
        return method(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(patched, name, raise_killed)
        with pytest.raises(Killed):
            save(demonstrations)


@pytest.mark.parametrize("killed_method", [(MinariStorage, "update_metadata"), (Path, "rename")])
def test_a_killed_save_creates_no_data_set(killed_method, local_demonstrations, minari_folder):
    kill_save(*killed_method, 1, local_demonstrations)
    assert any(minari_folder.glob(f"{writing.SCRATCH}*"))  # the unfinished data set
    assert not storage.has_dataset(NAME)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Minari warns about incomplete data sets
        assert list(minari.list_local_datasets()) == []
        save(local_demonstrations)
        assert list(minari.list_local_datasets()) == [NAME]
    assert_same(storage.load(NAME, LEVEL).demonstrations, local_demonstrations)
    assert not any(minari_folder.glob(f"{writing.SCRATCH}*"))


def test_a_killed_save_keeps_the_previous_data_set(saved):
    kill_save(MinariStorage, "update_metadata", 1, saved[:1])
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)
    kill_save(Path, "rename", 2, saved[:1])  # between two renames; the next save repairs it
    assert not storage.has_dataset(NAME)
    save(saved[:1], "leapjax/other-v0")
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_saving_does_not_replace_a_folder_of_data_sets(saved):
    parent = NAME.rpartition("/")[0]
    with pytest.raises(UserError, match=f"{parent!r} is a folder of data sets"):
        save(saved[:1], parent)
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_concurrent_saves_write_one_data_set(local_demonstrations, minari_folder):
    """Threads share a process id, as processes in containers may; the folder is empty."""
    with futures.ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(save, local_demonstrations) for _ in range(4)]
        for job in jobs:
            job.result()
    assert_same(storage.load(NAME, LEVEL).demonstrations, local_demonstrations)
    assert sorted(path.name for path in minari_folder.iterdir()) == [writing.LOCK, "leapjax"]


def test_a_full_disk_raises_an_error(local_demonstrations, monkeypatch):
    monkeypatch.setattr(files, "SPARE", 2**60)
    with pytest.raises(UserError, match=r"\d+ MiB are free in .* make room"):
        save(local_demonstrations)

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "SPARE", 0)
    monkeypatch.setattr(MinariStorage, "update_metadata", full)
    with pytest.raises(UserError, match="cannot write the data set .*No space left on device"):
        save(local_demonstrations)
    assert not storage.has_dataset(NAME)


@pytest.mark.parametrize("path", ["file", "", "file/sets"])
def test_an_impossible_folder_of_data_sets_raises_an_error(path, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", path)
    with pytest.raises(UserError, match="MINARI_DATASETS_PATH"):
        storage.has_dataset(NAME)


@pytest.mark.parametrize("name", ["leapjax/none-v0", "no such name!", "leapjax/GoToLocalS7N5"])
def test_a_missing_data_set_raises_an_error(saved, name):
    assert "no Minari data set" in load_error(name)
    assert storage.has_dataset(NAME) and not storage.has_dataset("a" * 300)


def test_errors_suggest_deleting_only_data_that_the_library_made(minari_folder):
    ours, theirs = storage.name_dataset(LEVEL, 1, 0), "my/own-v0"
    for name in (ours, theirs):
        (minari_folder / name / "data").mkdir(parents=True)
        assert "cannot be read" in load_error(name)
    assert load_error(ours).endswith("delete it and it is made again, or restore it")
    assert load_error(theirs).endswith("): restore it")


def announce_episodes(folder):
    """Changes the number of episodes in the metadata."""
    path = folder / "metadata.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "total_episodes": 10**12}))


def truncate_file(folder):
    path = folder / "main_data.hdf5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])


def replace_by_pipe(folder):
    (folder / "metadata.json").unlink()
    os.mkfifo(folder / "metadata.json")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (truncate_file, "cannot be read"),
        (lambda folder: (folder / "metadata.json").write_text("[" * 100_000), "cannot be read"),
        (lambda folder: (folder / "metadata.json").unlink(), "cannot be read"),
        (lambda folder: (folder / "main_data.hdf5").unlink(), "cannot be read"),
        (replace_by_pipe, "cannot be read"),
        (shutil.rmtree, "no Minari data set"),
        (announce_episodes, "1000000000000 episodes are announced, 5 are"),
    ],
)
def test_damaged_files_raise_an_error(saved, minari_folder, change, reason):
    change(minari_folder / NAME / "data")
    assert reason in load_error()


def edit(field, change, episode="episode_2"):
    """Makes a change of one array of an episode."""

    def replace(file):
        values = change(file[episode][field][()])
        del file[episode][field]
        file[episode][field] = values

    return replace


def set_first(field, value):
    """Makes a change of the first number in an array of an episode."""

    def set_number(file):
        values = file["episode_3"][field]
        values[(0,) * values.ndim] = value

    return set_number


def add_info(build):
    """Makes a change of the infos, which Minari reads and leapjax does not need."""
    return lambda file: build(file["episode_0"].require_group("infos"))


def add_diamonds(group):
    """Adds a chain of groups with two names each, so that 2^40 paths lead to the last."""
    for _ in range(40):
        group["left"] = inner = group.file.create_group(None)
        group["right"] = inner
        group = inner


def add_chain(group):
    for _ in range(500):
        group = group.create_group("x")


def write_zeros(group, name, shape):
    """Replaces an array by zeros: half a gigabyte in half a megabyte of the file."""
    del group[name]
    chunk = (2**22, *shape[1:])
    array = group.create_dataset(name, shape, "u1", chunks=chunk, compression="gzip")
    packed = zlib.compress(bytes(math.prod(chunk)), 9)
    for start in range(0, shape[0], chunk[0]):
        array.id.write_direct_chunk((start, *(0 for _ in shape[1:])), packed)


def replace_by_zeros(name, shape):
    return lambda file: write_zeros(file["episode_0"], name, shape)


def enlarge_chunks(group, name):
    """Stores an array in a chunk of 400 MB, which HDF5 would unpack for its few numbers."""
    values = group[name][:]
    del group[name]
    group.create_dataset(
        name, data=values, maxshape=(None,), chunks=(50_000_000,), compression="gzip"
    )


GOAL = "observations/goal"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda file: file.__delitem__("episode_2"), "cannot be read"),
        (lambda file: file.move("episode_1", "episode_7"), "episode_1 is not there"),
        (lambda file: file["episode_1"].__delitem__("rewards"), "rewards"),
        (lambda file: enlarge_chunks(file["episode_1"], "rewards"), "in pieces of 400000000 bytes"),
        (edit(GOAL, lambda values: values[:-1]), "goal has shape"),
        (edit(GOAL, lambda values: np.full(len(values), b"x")), "goal"),
        (edit("actions", lambda values: values[:0]), "no actions"),
        (edit("actions", lambda values: values.astype(np.int64) + 2**32), "actions run from"),
        (edit("rewards", lambda values: np.append(values, 1.0)), "rewards have shape"),
        (edit("rewards", lambda values: values + 1e300), "numbers that do not fit float32"),
        (edit("terminations", np.ones_like), "ended with step 0, and it goes on to step"),
        (edit("truncations", lambda marks: marks[-1]), "have shape ()"),
        (edit("truncations", lambda marks: np.full(len(marks), 2)), "must be true or false"),
        (edit("truncations", lambda marks: np.full(len(marks), b"yes")), "must be true or fal"),
        (set_first("rewards", np.nan), "rewards: numbers that do not fit float32"),
        (set_first("observations/grid", 11), "grid objects"),
        (set_first("observations/pose", 7), "positions"),
        (set_first("observations/goal", -2), "goals"),
        (set_first("observations/instruction", 100), "instruction"),
        (set_first("actions", 6), "actions"),
        (add_info(add_diamonds), "is an object that has another name too"),
        (add_info(lambda group: group.__setitem__("root", group.file["/"])), "another name"),
        (add_info(add_chain), "is a group in 17 groups"),
        (add_info(lambda group: group.__setitem__("kind", np.dtype("f4"))), "not an array of this"),
        # Shapes are checked before arrays are unpacked.
        (replace_by_zeros("observations/instruction", (2**27, 4)), "has shape (134217728, 4)"),
        (replace_by_zeros("actions", (2**29,)), "rewards have shape"),
    ],
)
def test_damaged_arrays_raise_an_error(saved, minari_folder, monkeypatch, change, reason):
    with h5py.File(file_of(minari_folder), "r+") as file:
        change(file)
    assert file_of(minari_folder).stat().st_size < 2**21
    if "has shape (134" in reason:
        monkeypatch.setattr(minari, "load_dataset", lambda name: pytest.fail("it is read"))
    assert reason in load_error()


def test_data_of_another_level_raise_an_error(saved, minari_folder):
    with h5py.File(file_of(minari_folder), "r+") as file:  # marks may be floats
        edit("terminations", lambda marks: marks.astype(np.float32))(file)
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)
    assert "level PickUpLoc needs" in load_error(domain=BABYAI.make("PickUpLoc", Settings()))


@pytest.mark.parametrize(
    ("stored", "seed"),
    [
        (2**64 - 1, 2**64 - 1), (str(2**32), 2**32), (-5, storage.UNKNOWN_SEED),
        (str(2**70), storage.UNKNOWN_SEED), (None, storage.UNKNOWN_SEED),
    ],
)  # fmt: skip
def test_seeds_of_64_bits_are_kept_and_others_become_unknown(saved, minari_folder, stored, seed):
    with h5py.File(file_of(minari_folder), "r+") as file:
        attributes = file["episode_0"].attrs
        del attributes["seed"]
        if stored is not None:
            attributes["seed"] = np.uint64(stored) if stored == 2**64 - 1 else stored
    loaded = storage.load(NAME, LEVEL)
    assert loaded.demonstrations[0].seed == seed
    assert loaded.demonstrations[1].seed == saved[1].seed


def test_arrays_larger_than_memory_are_not_unpacked(saved, minari_folder, monkeypatch):
    with h5py.File(file_of(minari_folder), "r+") as file:
        infos = file["episode_3"].require_group("infos")
        infos["x"] = 0
        write_zeros(infos, "x", (2**22,))
    memory = {"SC_PAGE_SIZE": 2**10, "SC_PHYS_PAGES": 2**13}  # 8 MiB
    monkeypatch.setattr(os, "sysconf", memory.__getitem__)
    assert_same(storage.load(NAME, LEVEL, most=3).demonstrations, saved[:3])  # skips episode 3
    monkeypatch.setattr(minari, "load_dataset", lambda name: pytest.fail("it is read"))
    assert "at least 0 GiB of memory would be needed" in load_error()


PICTURE = np.zeros((32, 40, 3), np.uint8)


def write_frames(frames):
    """Writes pictures as JPEG with Minari alone: one truncated episode, without its seed."""
    steps = len(frames) - 1
    episode = EpisodeBuffer(
        id=0, observations=list(frames.astype(np.uint8)), actions=[0] * steps,
        rewards=[*map(float, range(steps))],
        terminations=[False] * steps, truncations=[False] * (steps - 1) + [True],
    )  # fmt: skip
    minari.create_dataset_from_buffers(
        dataset_id=NAME, buffer=[episode], jpeg_encoding=True,
        observation_space=gym.spaces.Box(0, 255, PICTURE.shape, np.uint8),
        action_space=gym.spaces.Discrete(6),
    )  # fmt: skip


NOISE = np.random.default_rng(0).integers(0, 256, (3, *PICTURE.shape))


# JPEG frames of equal or different lengths.
@pytest.mark.parametrize("frames", [np.zeros_like(NOISE), NOISE], ids=["alike", "different"])
def test_jpeg_pictures_without_a_seed_are_loaded(frames):
    write_frames(frames)
    with pytest.warns(UserWarning, match="stores pictures as JPEG, which changes them"):
        (found,) = storage.load(NAME, domain_of(PICTURE)).demonstrations
    assert found.truncated and found.seed == storage.UNKNOWN_SEED
    assert found.observations.shape == frames.shape
    assert found.observations.any() == frames.any()
    other = domain_of(np.zeros((32, 32, 3), np.uint8))
    assert "observations has shape (3, 32, 40, 3), level Line needs (3, 32, 32, 3)" in load_error(
        domain=other
    )


@pytest.mark.parametrize("shape", [(3000, 3000, 3), (40, 32, 3)])
def test_a_frame_of_another_size_is_not_unpacked(minari_folder, monkeypatch, shape):
    write_frames(NOISE)
    packed = io.BytesIO()
    Image.fromarray(np.zeros(shape, np.uint8)).save(packed, "JPEG")
    with h5py.File(file_of(minari_folder), "r+") as file:
        file["episode_0/observations"][1] = np.frombuffer(packed.getvalue(), np.uint8)
    monkeypatch.setattr(minari, "load_dataset", lambda name: pytest.fail("it is read"))
    assert "a frame of shape" in load_error(domain=domain_of(PICTURE))


def test_only_reasons_that_dropped_episodes_are_described():
    collection = Collection([], {"failed": 0, "too long": 2, "without a seed": 1})
    assert storage.describe_dropped(collection) == "2 too long, 1 without a seed"
