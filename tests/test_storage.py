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
from leapjax.data.storage import inspection, writing
from leapjax.domain import Collection, Domain
from leapjax.domains.babyai import levels, observations
from leapjax.domains.babyai.domain import BABYAI
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


def test_what_is_saved_is_loaded_and_replaced(saved):
    save(saved[:2], "leapjax/GoToLocalS7N5/other-v1")
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)
    assert_same(storage.load("leapjax/GoToLocalS7N5/other-v1", LEVEL).demonstrations, saved[:2])
    save(saved[3:])
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved[3:])


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


def domain_of(blank) -> Domain:
    """A world of one's own, whose observations look like `blank`."""

    def nothing(*arguments):
        raise NotImplementedError

    return Domain("Own", nothing, ("left", "right", "end"), 9, blank, {})


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


def put(folder, field, values):
    with h5py.File(file_of(folder), "r+") as file:
        instead(field, lambda before: values, "episode_0")(file)


def test_observations_of_another_world_are_refused(minari_folder):
    save([own_demonstration(ARRAY)], domain=domain_of(ARRAY))
    assert "no observation 'place'" in refused(domain=domain_of(FIELDS))
    assert "observations has shape (4, 4)" in refused(domain=domain_of(np.zeros(5, np.float32)))
    assert "must be integers" in refused(domain=domain_of(np.zeros(4, np.int32)))
    put(minari_folder, "observations", np.full((4, 4), np.nan))
    assert "not finite" in refused(domain=domain_of(ARRAY))
    save([own_demonstration(FIELDS)], domain=domain_of(FIELDS))
    assert "must be numbers" in refused(domain=domain_of(ARRAY))
    put(minari_folder, "observations/lamps", np.full((4, 2), 256))
    assert "do not fit uint8" in refused(domain=domain_of(FIELDS))


def test_demonstrations_that_an_earlier_version_wrote_are_refused(saved):
    name = "leapjax/GoToLocalS7N5/bot-5-seed0-v1"
    assert storage.dataset_id(LEVEL, 5, 0) == name.replace("v1", "v2")
    save(saved, name)
    assert "earlier version" in refused(name)
    save(saved, name.replace("v1", "v2"))
    assert_same(storage.load(name.replace("v1", "v2"), LEVEL).demonstrations, saved)


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
    assert any(minari_folder.glob(f"{writing.SCRATCH}*"))  # what a killed program leaves behind
    assert not storage.exists(NAME)
    assert "no Minari data set" in refused()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Minari warns of what is no data set
        assert list(minari.list_local_datasets()) == []
        save(local_demonstrations)
        assert list(minari.list_local_datasets()) == [NAME]
    assert_same(storage.load(NAME, LEVEL).demonstrations, local_demonstrations)
    assert not any(minari_folder.glob(f"{writing.SCRATCH}*"))


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
        writing.LOCK,
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


@pytest.mark.parametrize("name", ["leapjax/none-v0", "no such name!", "leapjax/GoToLocalS7N5"])
def test_a_missing_data_set(saved, name):
    assert "no Minari data set" in refused(name)
    assert storage.exists(NAME) and not storage.exists("a" * 300)


def test_nobody_is_told_to_delete_data_of_their_own(minari_folder):
    ours, theirs = storage.dataset_id(LEVEL, 1, 0), "my/own-v0"
    for name in (ours, theirs):
        (minari_folder / name / "data").mkdir(parents=True)
        assert "cannot be read" in refused(name)
    assert refused(ours).endswith("delete it and it is made again, or restore it")
    assert refused(theirs).endswith("): restore it")


def announced(**values):
    """A change of what the metadata say."""

    def change(folder):
        path = folder / "metadata.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **values}))

    return change


def cut_short(folder):
    path = folder / "main_data.hdf5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])


def endless(folder):
    (folder / "metadata.json").unlink()
    os.mkfifo(folder / "metadata.json")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (cut_short, "cannot be read"),
        (lambda folder: (folder / "metadata.json").write_text("{"), "cannot be read"),
        (lambda folder: (folder / "metadata.json").write_text("[" * 100_000), "cannot be read"),
        (lambda folder: (folder / "metadata.json").unlink(), "cannot be read"),
        (lambda folder: (folder / "main_data.hdf5").unlink(), "cannot be read"),
        (endless, "cannot be read"),
        (shutil.rmtree, "no Minari data set"),
        (announced(total_episodes=10**12), "1000000000000 episodes are announced, 5 are"),
        (announced(total_steps=None), "None steps are announced"),
    ],
)
def test_damaged_files(saved, minari_folder, change, says):
    change(minari_folder / NAME / "data")
    assert says in refused()


def test_no_episodes():
    save([])
    assert "no episodes" in refused()


def instead(field, change, episode="episode_2"):
    """A change of one array of an episode."""

    def replace(file):
        values = change(file[episode][field][()])
        del file[episode][field]
        file[episode][field] = values

    return replace


def first(field, value):
    """A change of one number."""

    def write(file):
        values = file["episode_3"][field]
        values[(0,) * values.ndim] = value

    return write


def in_infos(build):
    """A change of what Minari reads beside the arrays that are needed."""
    return lambda file: build(file["episode_0"].require_group("infos"))


def diamonds(group):
    """Each group is in the one before by two names: 2^40 ways lead to the last."""
    for _ in range(40):
        group["left"] = inner = group.file.create_group(None)
        group["right"] = inner
        group = inner


def chain(group):
    for _ in range(500):
        group = group.create_group("x")


def squeeze(group, name, shape):
    """Half a gigabyte of zeros, in half a megabyte of a file."""
    del group[name]
    chunk = (2**22, *shape[1:])
    array = group.create_dataset(name, shape, "u1", chunks=chunk, compression="gzip")
    packed = zlib.compress(bytes(math.prod(chunk)), 9)
    for start in range(0, shape[0], chunk[0]):
        array.id.write_direct_chunk((start, *(0 for _ in shape[1:])), packed)


def squeezed(name, shape):
    return lambda file: squeeze(file["episode_0"], name, shape)


NOT_A_MARK = "must be true or false"
MARKS = f"episode 2 of the Minari data set {NAME!r}: truncations"
GOAL = "observations/goal"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda file: file.__delitem__("episode_2"), "cannot be read"),
        (lambda file: file.move("episode_1", "episode_7"), "episode_1 is not there"),
        (lambda file: file["episode_2"].__delitem__(GOAL), "goal"),
        (lambda file: file["episode_1"].__delitem__("rewards"), "rewards"),
        (instead(GOAL, lambda values: values[:-1]), "goal has shape"),
        (instead("actions", lambda values: values[:0]), "no actions"),
        (instead("actions", lambda values: values.astype(np.int64) + 2**32), "actions run from"),
        (instead("rewards", lambda values: np.append(values, 1.0)), "rewards have shape"),
        (first("rewards", np.nan), "rewards: numbers that do not fit float32"),
        (instead("rewards", lambda values: values + 1e300), "numbers that do not fit float32"),
        (instead("terminations", np.ones_like), "ended with step 0"),
        (
            instead("truncations", lambda marks: np.arange(len(marks)) == 1),
            f"{MARKS} say that the episode ended with step 1, and it goes on to step",
        ),
        (instead("truncations", lambda marks: marks[-1]), "have shape ()"),
        (instead("truncations", lambda marks: np.full(len(marks), 2)), NOT_A_MARK),
        (instead("truncations", lambda marks: np.full(len(marks), np.nan)), NOT_A_MARK),
        (instead("truncations", lambda marks: np.full(len(marks), b"yes")), NOT_A_MARK),
        (first("observations/grid", 11), "grid objects"),
        (first("observations/pose", 7), "positions"),
        (first("observations/carried", -1), "carried objects"),
        (first("observations/goal", -2), "goals"),
        (first("observations/instruction", 100), "instruction"),
        (first("actions", 6), "actions"),
        (first("actions", -1), "actions"),
        (
            instead("observations/pose", lambda pose: pose + np.array([0, 0, 4])),
            "directions run from",
        ),
        (instead(GOAL, lambda values: np.full(len(values), b"x")), "goal"),
        (in_infos(diamonds), "is an object that has another name too"),
        (in_infos(lambda group: group.__setitem__("root", group.file["/"])), "another name"),
        (in_infos(chain), "is a group in 17 groups"),
        (in_infos(lambda group: group.__setitem__("kind", np.dtype("f4"))), "not an array of this"),
        # Shapes are compared before anything is unpacked.
        (squeezed("observations/instruction", (2**27, 4)), "has shape (134217728, 4)"),
        (squeezed("actions", (2**29,)), "rewards have shape"),
    ],
)
def test_damaged_arrays(saved, minari_folder, monkeypatch, change, says):
    with h5py.File(file_of(minari_folder), "r+") as file:
        change(file)
    assert file_of(minari_folder).stat().st_size < 2**21
    if "has shape (134" in says:
        monkeypatch.setattr(minari, "load_dataset", lambda name: pytest.fail("it is read"))
    assert says in refused()


def test_marks_of_the_end_in_numbers(saved, minari_folder):
    with h5py.File(file_of(minari_folder), "r+") as file:
        instead("terminations", lambda marks: marks.astype(np.float32))(file)
    assert_same(storage.load(NAME, LEVEL).demonstrations, saved)


def test_another_level_or_shape(saved):
    assert "level PickUpLoc needs" in refused(domain=BABYAI.make("PickUpLoc", Settings()))
    for side, words, field in ((8, WORDS, "grid"), (SIDE, 9, "instruction")):
        other = LEVEL._replace(blank=observations.blank(side, words))
        assert f"{field} has shape" in refused(domain=other)


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
        inspection._check_varying(file["episode_0/infos/words"], "words", 9_999)


def other_data_set(space, states, action_space=None, actions=None) -> None:
    """A data set of somebody else, of one episode and without its seed."""
    steps = len(jax.tree.leaves(states)[0]) - 1
    minari.create_dataset_from_buffers(
        dataset_id=NAME,
        buffer=[
            EpisodeBuffer(
                id=0, observations=states, actions=[0] * steps if actions is None else actions,
                rewards=[float(reward) for reward in range(steps)],
                terminations=[False] * steps, truncations=[False] * (steps - 1) + [True],
            )
        ],
        observation_space=space, action_space=action_space or gym.spaces.Discrete(6),
        jpeg_encoding=False,
    )  # fmt: skip


LETTERS = gym.spaces.Text(20, charset="abcdefghijklmnopqrstuvwxyz ")
MINIGRID = {
    "image": gym.spaces.Box(0, 255, (7, 7, 3), np.uint8),
    "direction": gym.spaces.Discrete(4),
    "mission": LETTERS,
}


@pytest.mark.parametrize(
    ("spaces", "change", "says"),
    [
        ({"grid": gym.spaces.Box(0, 1000, (SIDE, SIDE, 3), np.int32)},
         lambda states: {"grid": states["grid"].astype(np.int32) + 256}, "grid objects"),
        ({"grid": gym.spaces.Box(0, 1, (SIDE, SIDE, 3), np.float32)},
         lambda states: {"grid": states["grid"] / np.float32(255)}, "grid"),
        ({"instruction": LETTERS},
         lambda states: {"instruction": ["go to it"] * len(states["pose"])}, "instruction"),
        # "can be used": test_replay.py
        (MINIGRID, lambda states: {"image": states["grid"], "direction": states["pose"][:, 2],
                                   "mission": ["go to it"] * len(states["pose"])},
         "can be used, only 1 without the seed of their reset"),
    ],
)  # fmt: skip
def test_observations_of_other_data_sets(local_demonstrations, spaces, change, says):
    states = local_demonstrations[0].observations._asdict()
    known = storage.observation_space(LEVEL.blank).spaces
    if spaces is MINIGRID:
        other_data_set(gym.spaces.Dict(spaces), change(states))
    else:
        other_data_set(gym.spaces.Dict({**known, **spaces}), {**states, **change(states)})
    assert says in refused()


def test_arrays_and_continuous_actions_of_other_data_sets(local_demonstrations):
    box = gym.spaces.Box(-1, 1, (4,), np.float32)
    other_data_set(box, np.zeros((3, 4), np.float32))
    assert "no observation 'grid'" in refused()
    states, steps = local_demonstrations[0].observations, len(local_demonstrations[0].actions)
    minari.delete_dataset(NAME)
    space = storage.observation_space(LEVEL.blank)
    other_data_set(space, states._asdict(), box, np.zeros((steps, 4), np.float32))
    assert "action" in refused()


def test_a_users_data_set_without_seeds(local_demonstrations):
    [demonstration] = local_demonstrations[:1]
    other_data_set(
        storage.observation_space(LEVEL.blank), demonstration.observations._asdict(),
        gym.spaces.Discrete(6), list(demonstration.actions),
    )  # fmt: skip
    expected = demonstration._replace(
        rewards=np.arange(len(demonstration.actions), dtype=np.float32),
        terminated=False,
        truncated=True,
        seed=storage.UNKNOWN_SEED,
    )
    assert_same(storage.load(NAME, LEVEL).demonstrations, [expected])


def test_every_level_has_a_cache_of_its_own():
    known = [levels.find_level(name) for name in (*levels.LEVELS, *levels.registered_levels())]
    ids = [storage.dataset_id(LEVEL._replace(level=level.name), 500, 0) for level in known]
    ids += [storage.dataset_id(LEVEL, count, seed) for count in (5, 50) for seed in (0, 1)]
    shared = {ids[i] for i in range(len(ids)) if ids[i] in ids[:i]}
    assert not shared
