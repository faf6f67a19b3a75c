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
from minari.dataset.minari_dataset import parse_dataset_id
from minari.dataset.minari_storage import MinariStorage
from PIL import Image

from leapjax import files
from leapjax.data import storage
from leapjax.domain import Collection, Described, Domain
from leapjax.domains.babyai import levels, observations
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from leapjax.errors import UserError
from leapjax.types import Demonstration

LEVEL = BABYAI.make("GoToLocalS7N5", Settings())
SIDE, WORDS = 7, 5
NAME = "leapjax/GoToLocalS7N5/test-v1"


def file_of(folder, name: str = NAME):
    return folder / name / "data" / "main_data.hdf5"


def save(demonstrations: list[Demonstration], name: str = NAME, domain: Domain = LEVEL) -> None:
    storage.save(name, Collection(demonstrations, {}), domain, "for a test")


def refused(name: str = NAME, domain: Domain = LEVEL) -> str:
    """The one line with which a data set is refused."""
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


def test_what_is_saved_is_loaded(saved):
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_rewards_and_how_an_episode_ended_are_what_they_were(local_demonstrations):
    rng = np.random.default_rng(0)
    endings = [(True, False), (False, True), (True, True), (False, False)]
    changed = [
        d._replace(
            rewards=rng.normal(size=len(d.actions)).astype(np.float32),
            terminated=terminated,
            truncated=truncated,
        )
        for d, (terminated, truncated) in zip(local_demonstrations, endings, strict=False)
    ]
    save(changed)
    assert_same(storage.load(NAME, LEVEL).demonstrations, changed)


def test_minari_itself_can_read_it(saved):
    assert list(minari.list_local_datasets()) == [NAME]
    dataset = minari.load_dataset(NAME)
    assert dataset.total_episodes == len(saved)
    assert dataset.total_steps == sum(len(d.actions) for d in saved)
    for episode, demonstration in zip(dataset.iterate_episodes(), saved, strict=True):
        np.testing.assert_array_equal(episode.rewards, demonstration.rewards)
        assert 0 < episode.rewards[-1] <= 1 and not episode.rewards[:-1].any()
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
            np.ones((steps + 1, WORDS), np.int32),
        ),
        np.zeros(steps, np.int32),
        np.zeros(steps, np.float32),
        terminated=False,
        truncated=True,
        seed=7,
    )
    large = LEVEL._replace(blank=observations.blank(side, WORDS))
    save([demonstration], domain=large)
    assert_same(storage.load(NAME, large).demonstrations, [demonstration])


def domain_of(blank) -> Domain:
    """A world of one's own, whose observations look like `blank`."""

    def nothing(*arguments):
        raise NotImplementedError

    return Domain("Own", nothing, nothing, ("left", "right", "end"), 9, blank, {})


ARRAY = np.zeros(4, np.float32)
FIELDS = {"place": np.zeros((2, 3), np.float32), "lamps": np.zeros(2, np.uint8)}
NESTED = {"own": {"count": np.zeros((), np.int32)}, "picture": np.zeros((40, 40, 3), np.uint8)}


def own_demonstration(blank) -> Demonstration:
    rng = np.random.default_rng(0)
    states = jax.tree.map(lambda x: (100 * rng.random((4, *x.shape))).astype(x.dtype), blank)
    rewards = rng.normal(size=3).astype(np.float32)
    actions, unknown = np.array([0, 1, 1], np.int32), storage.UNKNOWN_SEED
    return Demonstration(states, actions, rewards, True, False, unknown)


@pytest.mark.parametrize("blank", [ARRAY, FIELDS, NESTED], ids=["array", "fields", "nested"])
def test_observations_of_any_world(blank):
    demonstrations = [own_demonstration(blank)] * 2
    save(demonstrations, domain=domain_of(blank))
    assert_same(storage.load(NAME, domain_of(blank)).demonstrations, demonstrations)


def test_observations_of_another_world_are_refused(minari_folder):
    save([own_demonstration(ARRAY)], domain=domain_of(ARRAY))
    assert "no observation 'place'" in refused(domain=domain_of(FIELDS))
    assert "observations has shape (4, 4)" in refused(domain=domain_of(np.zeros(5, np.float32)))
    assert "must be integers" in refused(domain=domain_of(np.zeros(4, np.int32)))
    replace(file_of(minari_folder), "episode_0", "observations", np.full((4, 4), np.nan))
    assert "not finite" in refused(domain=domain_of(ARRAY))
    save([own_demonstration(FIELDS)], domain=domain_of(FIELDS))
    assert "must be numbers" in refused(domain=domain_of(ARRAY))
    replace(file_of(minari_folder), "episode_0", "observations/lamps", np.full((4, 2), 256))
    assert "do not fit uint8" in refused(domain=domain_of(FIELDS))


def test_demonstrations_that_an_earlier_version_wrote_are_refused(saved):
    name = "leapjax/GoToLocalS7N5/bot-5-seed0-v1"
    assert storage.dataset_id(LEVEL, 5, 0) == name.replace("v1", "v2")
    save(saved, name)
    assert "earlier version" in refused(name)
    save(saved, name.replace("v1", "v2"))
    assert_same(storage.load(name.replace("v1", "v2"), LEVEL).demonstrations, saved)


def test_saving_again_replaces(saved):
    save(saved[3:])
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved[3:])


def test_data_sets_live_side_by_side(saved):
    save(saved[:2], "leapjax/GoToLocalS7N5/other-v1")
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)
    assert_same(storage.load("leapjax/GoToLocalS7N5/other-v1", LEVEL).demonstrations, saved[:2])


class Killed(BaseException):
    """What a program that dies in the middle is to its callers."""


@pytest.mark.parametrize("moment", ["writing", "renaming"])
def test_a_killed_save_leaves_nothing_under_the_name(
    moment, local_demonstrations, monkeypatch, minari_folder
):
    with monkeypatch.context() as patch:
        if moment == "writing":
            patch.setattr(MinariStorage, "update_metadata", die)
        else:
            patch.setattr(Path, "rename", die)
        with pytest.raises(Killed):
            save(local_demonstrations)
    assert any(minari_folder.glob(f"{storage.SCRATCH}*"))  # what a killed program leaves behind
    assert not storage.exists(NAME)
    assert "no Minari data set" in refused()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Minari warns of what is no data set
        assert list(minari.list_local_datasets()) == []
        save(local_demonstrations)
        assert list(minari.list_local_datasets()) == [NAME]
    assert_same(storage.load(NAME, LEVEL).demonstrations, local_demonstrations)
    assert not any(minari_folder.glob(f"{storage.SCRATCH}*"))


def die(*args, **kwargs):
    raise Killed


def test_a_killed_save_leaves_what_was_there(saved, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(MinariStorage, "update_metadata", die)
        with pytest.raises(Killed):
            save(saved[:1])
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_a_save_that_is_killed_between_two_names_is_mended_by_the_next(saved, monkeypatch):
    rename, calls = Path.rename, []

    def die_at_the_second(path, target):
        calls.append(path)
        return rename(path, target) if len(calls) == 1 else die()

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", die_at_the_second)
        with pytest.raises(Killed):
            save(saved[:1])
    assert not storage.exists(NAME)
    save(saved[:1], "leapjax/other-v0")
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_a_data_set_does_not_take_the_place_of_a_folder_of_others(saved):
    parent = NAME.rpartition("/")[0]
    with pytest.raises(UserError, match=f"{parent!r} is a folder of data sets"):
        save(saved[:1], parent)
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_a_name_that_no_file_may_have():
    assert not storage.exists("a" * 300)


def test_room_is_asked_for_all_that_is_written(local_demonstrations, monkeypatch, minari_folder):
    asked = []
    monkeypatch.setattr(files, "check_room", lambda folder, needed: asked.append(needed))
    save(local_demonstrations)
    assert file_of(minari_folder).stat().st_size < asked[0]


def test_several_processes_make_the_same_data_set(local_demonstrations, minari_folder):
    """Threads with one process id, as processes in containers have, on an empty folder."""
    with futures.ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(save, local_demonstrations) for _ in range(4)]
        for job in jobs:
            job.result()
    assert_same(storage.load(NAME, LEVEL).demonstrations, local_demonstrations)
    assert sorted(path.name for path in minari_folder.iterdir()) == [
        storage.LOCK,
        "leapjax",
    ]


def test_a_disk_without_room_is_one_line(local_demonstrations, monkeypatch):
    monkeypatch.setattr(files, "SPARE", 2**60)
    with pytest.raises(UserError, match=r"\d+ MiB are free in .* make room"):
        save(local_demonstrations)

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "SPARE", 0)
    monkeypatch.setattr(MinariStorage, "update_metadata", full)
    with pytest.raises(UserError, match="cannot write the data set .*No space left on device"):
        save(local_demonstrations)
    assert not storage.exists(NAME)


@pytest.mark.parametrize("kind", ["a file", "empty", "below a file"])
def test_a_folder_of_data_sets_that_cannot_be(kind, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    path = {"a file": tmp_path / "file", "empty": "", "below a file": tmp_path / "file" / "sets"}
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(path[kind]))
    with pytest.raises(UserError, match="MINARI_DATASETS_PATH"):
        storage.exists(NAME)


def test_a_folder_of_data_sets_that_is_relative(local_demonstrations, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "sets")
    save(local_demonstrations)
    assert_same(storage.load(NAME, LEVEL).demonstrations, local_demonstrations)
    assert (tmp_path / "sets" / NAME).is_dir()


def test_exists():
    assert not storage.exists(NAME)


def test_exists_once_saved(saved):
    assert storage.exists(NAME)


@pytest.mark.parametrize("name", ["leapjax/none-v0", "none", "a/b/c/none-v3", "no such name!"])
def test_a_missing_data_set(name):
    assert "no Minari data set" in refused(name)


def test_a_namespace_is_not_a_data_set(saved):
    assert "no Minari data set" in refused("leapjax/GoToLocalS7N5")


def test_nobody_is_told_to_delete_data_of_their_own(minari_folder):
    ours, theirs = storage.dataset_id(LEVEL, 1, 0), "my/own-v0"
    for name in (ours, theirs):
        (minari_folder / name / "data").mkdir(parents=True)
        assert "cannot be read" in refused(name)
    assert refused(ours).endswith("delete it and it is made again, or restore it")
    assert refused(theirs).endswith("): restore it")


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_file(saved, minari_folder, kept):
    path = file_of(minari_folder)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    assert "cannot be read" in refused()


def test_a_file_of_garbage(saved, minari_folder):
    file_of(minari_folder).write_bytes(b"\x00garbage\n" * 1000)
    assert "cannot be read" in refused()


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "\x00", "[" * 100_000])
def test_damaged_metadata(saved, minari_folder, text):
    (minari_folder / NAME / "data" / "metadata.json").write_text(text)
    assert "cannot be read" in refused()


def test_metadata_that_have_no_end(saved, minari_folder):
    path = minari_folder / NAME / "data" / "metadata.json"
    path.unlink()
    os.mkfifo(path)
    assert storage.described(NAME) == Described()
    assert "cannot be read" in refused()


@pytest.mark.parametrize("name", ["main_data.hdf5", "metadata.json"])
def test_a_missing_file(saved, minari_folder, name):
    (minari_folder / NAME / "data" / name).unlink()
    assert "cannot be read" in refused()


def test_an_empty_folder(saved, minari_folder):
    shutil.rmtree(minari_folder / NAME / "data")
    assert "no Minari data set" in refused()


def test_a_missing_episode(saved, minari_folder):
    with h5py.File(file_of(minari_folder), "r+") as file:
        del file["episode_2"]
    assert "cannot be read" in refused()


@pytest.mark.parametrize("field", ["observations", "actions", "rewards", "observations/goal"])
def test_a_missing_part_of_an_episode(saved, minari_folder, field):
    with h5py.File(file_of(minari_folder), "r+") as file:
        del file["episode_2"][field]
    refused()


def test_no_episodes():
    save([])
    assert "no episodes" in refused()


@pytest.mark.parametrize(
    ("announced", "says"),
    [
        ({"total_episodes": 4}, "4 episodes are announced, 5 are there"),
        ({"total_episodes": 0, "total_steps": 0}, "0 episodes are announced, 5 are there"),
        ({"total_steps": 1}, "1 steps are announced"),
        ({"total_steps": None}, "None steps are announced"),
    ],
)
def test_numbers_of_episodes_and_steps_that_are_not_so(saved, minari_folder, announced, says):
    path = minari_folder / NAME / "data" / "metadata.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **announced}))
    assert says in refused()


@pytest.mark.parametrize("marks", ["terminations", "truncations"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda marks: np.arange(len(marks)) == 1, "ended with step 1, and it goes on to step"),
        (lambda marks: np.ones_like(marks), "ended with step 0"),
        (lambda marks: marks[:-1], "have shape"),
        (lambda marks: np.append(marks, True), "have shape"),
        (lambda marks: marks[-1], "have shape ()"),
        (lambda marks: np.full(len(marks), np.nan), "must be true or false"),
        (lambda marks: np.full(len(marks), 2), "must be true or false"),
        (lambda marks: np.full(len(marks), b"yes"), "must be true or false"),
    ],
)
def test_marks_of_the_end_that_contradict_the_episode(saved, minari_folder, marks, change, says):
    with h5py.File(file_of(minari_folder)) as file:
        before = file["episode_2"][marks][()]
    replace(file_of(minari_folder), "episode_2", marks, change(before))
    message = refused()
    assert f"episode 2 of the Minari data set {NAME!r}: {marks}" in message and says in message


def test_marks_of_the_end_in_numbers(saved, minari_folder):
    ends = np.arange(len(saved[0].actions)) == len(saved[0].actions) - 1
    replace(file_of(minari_folder), "episode_0", "terminations", ends.astype(np.float32))
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_another_level(saved):
    assert "level PickUpLoc needs" in refused(domain=BABYAI.make("PickUpLoc", Settings()))


@pytest.mark.parametrize(
    ("side", "words", "field"), [(6, WORDS, "grid"), (8, WORDS, "grid"), (SIDE, 9, "instruction")]
)
def test_another_shape(saved, side, words, field):
    other = LEVEL._replace(blank=observations.blank(side, words))
    assert f"{field} has shape" in refused(domain=other)


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


@pytest.mark.parametrize(
    ("stored", "seed"),
    [
        (2**63 + 5, 2**63 + 5), (2**64 - 1, 2**64 - 1), (str(2**32), 2**32),
        (-5, storage.UNKNOWN_SEED), (str(2**70), storage.UNKNOWN_SEED),
        (None, storage.UNKNOWN_SEED),
    ],
)  # fmt: skip
def test_seeds_of_64_bits_are_kept_and_others_unknown(saved, minari_folder, stored, seed):
    with h5py.File(file_of(minari_folder), "r+") as file:
        attributes = file["episode_0"].attrs
        del attributes["seed"]
        if stored is not None:
            attributes["seed"] = np.uint64(stored) if stored == 2**64 - 1 else stored
    loaded = storage.load(NAME, LEVEL)
    assert loaded.demonstrations[0].seed == seed
    assert loaded.demonstrations[1].seed == saved[1].seed
    save(loaded.demonstrations)  # and again
    assert_same(storage.load(NAME, LEVEL).demonstrations, loaded.demonstrations)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_rewards_that_are_not_finite(saved, minari_folder, bad):
    with h5py.File(file_of(minari_folder), "r+") as file:
        file["episode_1"]["rewards"][0] = bad
    message = refused()
    assert "episode 1" in message and "rewards: numbers that do not fit float32" in message


@pytest.mark.parametrize("field", ["actions", "rewards", "terminations"])
def test_a_group_in_the_place_of_an_array(saved, minari_folder, field):
    with h5py.File(file_of(minari_folder), "r+") as file:
        del file["episode_1"][field]
        file["episode_1"].create_group(field)
    assert f"{field} " in refused()


def test_rewards_of_another_length(saved, minari_folder):
    rewards = np.append(saved[2].rewards, 1.0)
    replace(file_of(minari_folder), "episode_2", "rewards", rewards)
    assert "rewards have shape" in refused()


def test_actions_of_64_bits_do_not_wrap_around(saved, minari_folder):
    actions = saved[0].actions.astype(np.int64) + 2**32
    replace(file_of(minari_folder), "episode_0", "actions", actions)
    assert "actions run from" in refused()


def in_infos(build):
    """A change of what Minari reads beside the arrays that are needed."""
    return lambda file: build(file["episode_0"].require_group("infos"))


def diamonds(group):
    """Each group is in the one before by two names: 2^40 ways lead to the last."""
    for _ in range(40):
        group["left"] = inner = group.file.create_group(None)
        group["right"] = inner
        group = inner


def ring(group):
    innermost = group.create_group("a/b/c")
    innermost["again"] = group["a"]


def chain(group):
    for _ in range(500):
        group = group.create_group("x")


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (in_infos(diamonds), "is an object that has another name too"),
        (in_infos(ring), "is an object that has another name too"),
        (in_infos(lambda group: group.__setitem__("root", group.file["/"])), "another name"),
        (in_infos(lambda group: group.__setitem__("r", group.parent["rewards"])), "another name"),
        (in_infos(chain), "is a group in 17 groups"),
        (in_infos(lambda group: group.__setitem__("kind", np.dtype("f4"))), "not an array of this"),
        (lambda file: file.move("episode_1", "episode_7"), "episode_1 is not there"),
        (lambda file: file["episode_0"].__setitem__("x", file["episode_1"]), "another name"),
    ],
)
def test_groups_that_are_no_tree_of_episodes(saved, minari_folder, build, says):
    with h5py.File(file_of(minari_folder), "r+") as file:
        build(file)
    assert says in refused()


def squeeze(group, name, shape):
    """Half a gigabyte of zeros, in half a megabyte of a file."""
    del group[name]
    chunk = (2**22, *shape[1:])
    array = group.create_dataset(name, shape, "u1", chunks=chunk, compression="gzip")
    packed = zlib.compress(bytes(math.prod(chunk)), 9)
    for start in range(0, shape[0], chunk[0]):
        array.id.write_direct_chunk((start, *(0 for _ in shape[1:])), packed)


@pytest.mark.parametrize(
    ("name", "shape", "says"),
    [
        ("observations/instruction", (2**27, 4), "instruction has shape (134217728, 4)"),
        ("observations/pose", (2**29,), "pose has shape"),
        ("actions", (2**29,), "rewards have shape"),
        ("rewards", (2**29,), "rewards have shape"),
        ("terminations", (2**29,), "terminations have shape"),
    ],
)
def test_shapes_are_compared_before_anything_is_unpacked(
    saved, minari_folder, monkeypatch, name, shape, says
):
    with h5py.File(file_of(minari_folder), "r+") as file:
        squeeze(file["episode_0"], name, shape)
    assert file_of(minari_folder).stat().st_size < 2**20
    monkeypatch.setattr(minari, "load_dataset", lambda name: pytest.fail("it is read"))
    assert says in refused()


def test_what_does_not_fit_into_memory_is_not_unpacked(saved, minari_folder, monkeypatch):
    with h5py.File(file_of(minari_folder), "r+") as file:
        squeeze_infos = file["episode_3"].require_group("infos")
        squeeze_infos["x"] = 0
        squeeze(squeeze_infos, "x", (2**22,))
    memory = {"SC_PAGE_SIZE": 2**10, "SC_PHYS_PAGES": 2**13}  # 8 MiB
    monkeypatch.setattr(os, "sysconf", memory.__getitem__)
    assert_same(storage.load(NAME, LEVEL, most=3).demonstrations, saved[:3])  # it is not needed
    monkeypatch.setattr(minari, "load_dataset", lambda name: pytest.fail("it is read"))
    assert "at least 0 GiB of memory would be needed" in refused()


def test_an_array_is_not_widened_to_be_checked():
    wide = np.broadcast_to(np.zeros((), np.uint8), (2**40,))  # takes a byte
    assert storage._numbers(np.zeros((), np.int64), wide, "it") is wide


PICTURE = np.zeros((32, 40, 3), np.uint8)


def save_frames(frames):
    """A data set of pictures that Minari keeps as JPEG."""
    steps = len(frames) - 1
    minari.create_dataset_from_buffers(
        dataset_id=NAME,
        buffer=[
            EpisodeBuffer(
                id=0, observations=list(frames), actions=[0] * steps, rewards=[1.0] * steps,
                terminations=[False] * (steps - 1) + [True], truncations=[False] * steps,
            )
        ],
        observation_space=gym.spaces.Box(0, 255, PICTURE.shape, np.uint8),
        action_space=gym.spaces.Discrete(2),
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["alike", "different"])  # in frames of one length, or of several
def test_pictures_that_minari_keeps_as_jpeg(kind):
    rng = np.random.default_rng(0)
    frames = np.stack([PICTURE] * 3)
    if kind == "different":
        frames = rng.integers(0, 256, (3, *PICTURE.shape)).astype(np.uint8)
    save_frames(frames)
    (found,) = storage.load(NAME, domain_of(PICTURE)).demonstrations
    assert found.observations.shape == frames.shape
    assert kind == "different" or not found.observations.any()
    other = domain_of(np.zeros((32, 32, 3), np.uint8))
    assert "observations has shape (3, 32, 40, 3), level Own needs (3, 32, 32, 3)" in refused(
        domain=other
    )


@pytest.mark.parametrize("shape", [(3000, 3000, 3), (32, 40), (40, 32, 3)])
def test_a_frame_of_another_size_is_not_unpacked(minari_folder, monkeypatch, shape):
    save_frames(np.random.default_rng(0).integers(0, 256, (3, *PICTURE.shape)).astype(np.uint8))
    packed = io.BytesIO()
    Image.fromarray(np.zeros(shape, np.uint8)).save(packed, "JPEG")
    with h5py.File(file_of(minari_folder), "r+") as file:
        file["episode_0/observations"][1] = np.frombuffer(packed.getvalue(), np.uint8)
    monkeypatch.setattr(minari, "load_dataset", lambda name: pytest.fail("it is read"))
    assert "a frame of shape" in refused(domain=domain_of(PICTURE))


def test_bytes_of_varying_length_that_the_file_does_not_hold(minari_folder, saved):
    with h5py.File(file_of(minari_folder), "r+") as file:
        infos = file["episode_0"].require_group("infos")
        infos["words"] = np.array(["a" * 1000] * 10, h5py.string_dtype())
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)
    with (
        h5py.File(file_of(minari_folder)) as file,
        pytest.raises(ValueError, match="words claims 10000 bytes, which are not there"),
    ):
        storage._check_varying(file["episode_0/infos/words"], "words", 9_999)


def other_data_set(observation_space, observations, action_space, actions, **episode) -> None:
    steps = len(actions)
    minari.create_dataset_from_buffers(
        dataset_id=NAME,
        buffer=[
            EpisodeBuffer(
                id=0,
                observations=observations,
                actions=actions,
                rewards=[float(reward) for reward in range(steps)],
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
    assert "can be used, only 1 without the seed of their reset" in refused()  # test_replay.py


def test_a_users_data_set_without_seeds(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    other_data_set(
        storage.observation_space(LEVEL.blank),
        demonstration.observations._asdict(),
        gym.spaces.Discrete(6),
        list(demonstration.actions),
    )
    expected = demonstration._replace(
        rewards=np.arange(len(demonstration.actions), dtype=np.float32),
        terminated=False,
        truncated=True,
        seed=storage.UNKNOWN_SEED,
    )
    assert_same(storage.load(NAME, LEVEL).demonstrations, [expected])


def test_fields_of_text_instead_of_numbers(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    space = storage.observation_space(LEVEL.blank)
    space["instruction"] = gym.spaces.Text(20, charset="abcdefghijklmnopqrstuvwxyz ")
    states = demonstration.observations._asdict()
    states["instruction"] = ["go to the red ball"] * len(states["pose"])
    other_data_set(space, states, gym.spaces.Discrete(6), list(demonstration.actions))
    refused()


def test_continuous_actions(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    steps = len(demonstration.actions)
    other_data_set(
        storage.observation_space(LEVEL.blank),
        demonstration.observations._asdict(),
        gym.spaces.Box(0, 1, (2,), np.float32),
        list(np.full((steps, 2), 0.5, np.float32)),
    )
    refused()


def test_numbers_that_wrap_around_are_out_of_range(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    space = storage.observation_space(LEVEL.blank)
    space["grid"] = gym.spaces.Box(0, 1000, (SIDE, SIDE, 3), np.int32)
    states = demonstration.observations._asdict()
    states["grid"] = states["grid"].astype(np.int32) + 256
    other_data_set(space, states, gym.spaces.Discrete(6), list(demonstration.actions))
    assert "grid objects" in refused()


def test_numbers_that_are_not_whole(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    space = storage.observation_space(LEVEL.blank)
    space["grid"] = gym.spaces.Box(0, 1, (SIDE, SIDE, 3), np.float32)
    states = demonstration.observations._asdict()
    states["grid"] = states["grid"] / np.float32(255)  # scaled, as pictures often are
    other_data_set(space, states, gym.spaces.Discrete(6), list(demonstration.actions))
    refused()


def test_every_level_has_a_cache_of_its_own():
    known = [levels.find_level(name) for name in (*levels.LEVELS, *levels.registered_levels())]
    ids = [storage.dataset_id(LEVEL._replace(level=level.name), 500, 0) for level in known]
    shared = {ids[i] for i in range(len(ids)) if ids[i] in ids[:i]}
    assert not shared


def test_every_count_and_seed_has_a_cache_of_its_own():
    ids = {storage.dataset_id(LEVEL, count, seed) for count in (5, 50) for seed in (0, 1)}
    assert len(ids) == 4
    for name in ids:
        namespace, short, version = parse_dataset_id(name)
        assert namespace and short and version is not None
