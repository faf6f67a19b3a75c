import gzip
import io
import os
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from leapjax import files
from leapjax.data.storage import UNKNOWN_SEED
from leapjax.domains.atari import replay
from leapjax.domains.atari.games import GAMES
from leapjax.domains.atari.replay import CUT_AFTER, CUT_BEFORE, Episode, writing
from leapjax.domains.atari.replay.shards import write_header
from leapjax.errors import UserError

PONG = GAMES["Pong"]
STORED = {"observation": np.uint8, "action": np.int32}
STORED |= {"reward": np.float32, "terminal": np.uint8}
READ = [f"$store$_{name}" for name in STORED]
OBSERVATION, ACTION, *_ = READ


def make_episodes(lengths, seed: int = 0) -> list[Episode]:
    """Makes episodes whose frames identify the episode and the step."""
    return [_make_episode(length, 1000 * seed + i) for i, length in enumerate(lengths)]


def _make_episode(length: int, seed: int) -> Episode:
    rng = np.random.default_rng(seed)
    frames = np.zeros((length, 84, 84), np.uint8)
    frames[:, :4, :4] = rng.integers(1, 256, (length, 4, 4))
    frames[:, 0, 0] = np.arange(length) % 256
    rewards = rng.integers(-1, 2, length).astype(np.float32)
    return Episode(frames, rng.integers(0, 6, length, np.int32), rewards)


def make_rows(episodes, padding: int = 3) -> dict[str, np.ndarray]:
    """Makes the rows that Dopamine's buffer adds for whole episodes, without a last stale row."""
    columns: dict[str, list] = {name: [] for name in STORED}
    for e in episodes:
        columns["observation"] += [np.zeros((padding, 84, 84)), e.frames]
        columns["action"] += [np.zeros(padding), e.actions]
        columns["reward"] += [np.zeros(padding), e.rewards]
        columns["terminal"] += [np.zeros(padding + len(e.actions) - 1), np.ones(1)]
    return {
        name: np.concatenate(c, dtype=STORED[name], casting="unsafe") for name, c in columns.items()
    }


def add_stale(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Appends a misleading row, as left by an earlier pass of the buffer."""
    last = {"observation": np.full((1, 84, 84), 99), "action": [5], "reward": [1], "terminal": [1]}
    return {name: np.concatenate([x, np.asarray(last[name], x.dtype)]) for name, x in rows.items()}


def store_shard(folder: Path, episodes, number: int = 0, dqn_seed: int = 1) -> Path:
    """Writes a shard of episodes, or of rows, using only NumPy and gzip."""
    rows = episodes if isinstance(episodes, dict) else add_stale(make_rows(episodes))
    logs = folder / "Pong" / str(dqn_seed) / "replay_logs"
    logs.mkdir(parents=True, exist_ok=True)
    count = len(rows["action"]) - 1
    arrays = {f"$store$_{name}": x for name, x in rows.items()}
    arrays |= {"add_count": np.array(count), "invalid_range": np.arange(count - 1, count + 4)}
    for part, array in arrays.items():
        with gzip.open(logs / f"{part}_ckpt.{number}.gz", "wb", compresslevel=1) as file:
            np.save(file, array, allow_pickle=False)
    return logs


def read(folder: Path, transitions: int = 10**9, seed: int = 0):
    return replay.read(folder, PONG, transitions, seed)


def read_error(folder: Path, game=PONG, **options) -> str:
    with pytest.raises(UserError) as raised:
        replay.read(folder, game, **{"transitions": 10**9, "seed": 0, **options})
    message = str(raised.value)
    assert "\n" not in message
    return message


def identify(demonstrations) -> list[bytes]:
    """Returns bytes that identify each trajectory."""
    return [np.asarray(d.observations[:-1]).tobytes() for d in demonstrations]


def assert_same_episodes(demonstrations, expected) -> None:
    """Asserts that demonstrations are these whole episodes, in any order."""
    assert len(demonstrations) == len(expected)
    by_frames = {e.frames.tobytes(): e for e in expected}
    for name, d in zip(identify(demonstrations), demonstrations, strict=True):
        e = by_frames.pop(name)
        np.testing.assert_array_equal(d.observations[-1], e.frames[-1])
        np.testing.assert_array_equal(d.actions, e.actions)
        np.testing.assert_array_equal(d.rewards, e.rewards)
        dtypes = (d.observations.dtype, d.actions.dtype, d.rewards.dtype)
        assert dtypes == (np.uint8, np.int32, np.float32)
        assert (d.terminated, d.truncated, d.seed) == (True, False, UNKNOWN_SEED)


def list_conversions(folder: Path) -> list[Path]:
    return sorted((folder / "Pong" / "1" / "leapjax").glob("*/frames.npy"))


@pytest.fixture(scope="module")
def three_shards(tmp_path_factory):
    """The folder of three shards, which tests must not change, and their 36 episodes."""
    folder = tmp_path_factory.mktemp("shards")
    groups = [make_episodes(range(3, 15), seed=number) for number in range(3)]
    for number, episodes in enumerate(groups):
        store_shard(folder, episodes, number)
    return folder, [e for episodes in groups for e in episodes]


def test_whole_trajectories_equal_the_stored_episodes(three_shards):
    folder, originals = three_shards
    demonstrations, dropped = read(folder)
    assert_same_episodes(demonstrations, originals)
    assert not dropped
    # Their frames are views of one memory map.
    assert not demonstrations[0].observations.flags.writeable
    assert len({id(d.observations._mmap) for d in demonstrations}) == 1


def test_episodes_cut_by_a_file_are_dropped_and_counted(tmp_path):
    episodes = make_episodes([20, 30, 40, 50])
    # Starts in the middle of the first episode, and ends in the middle of the last.
    store_shard(tmp_path, add_stale({name: x[10:133] for name, x in make_rows(episodes).items()}))
    for _ in range(2):  # from the shards, then from their conversion
        demonstrations, dropped = read(tmp_path)
        assert_same_episodes(demonstrations, episodes[1:3])
        assert dropped == {CUT_BEFORE: 1, CUT_AFTER: 1}


@pytest.mark.parametrize("padding", [3, 0])
def test_black_frames_of_an_episode_are_kept(tmp_path, padding):
    episodes = make_episodes([2, 3, 9, 1])
    for part in episodes[2]:
        part[:2] = 0  # two rows of zeros, where padding has three
    store_shard(tmp_path, add_stale(make_rows(episodes, padding)))
    demonstrations, dropped = read(tmp_path)
    # Without padding, the first episode may have begun before the file.
    assert_same_episodes(demonstrations, episodes if padding else episodes[1:])
    assert dropped == ({} if padding else {CUT_BEFORE: 1})


def test_sampling_takes_up_to_ten_episodes_in_order_per_visit(
    three_shards,
):
    folder, originals = three_shards
    for minimum in (1, 30, 100):
        lengths = [len(d.actions) for d in read(folder, minimum).demonstrations]
        assert sum(lengths[:-1]) < minimum <= sum(lengths)
    found = identify(read(folder, seed=5).demonstrations)
    shards = [[e.frames.tobytes() for e in originals[at : at + 12]] for at in (0, 12, 24)]
    assert [[name for name in found if name in shard] for shard in shards] == shards
    assert any(set(found[:10]) < set(shard) for shard in shards)


def test_sampling_depends_only_on_the_seed(three_shards):
    folder, _ = three_shards
    first = {seed: identify(read(folder, 60, seed).demonstrations) for seed in range(6)}
    shutil.rmtree(folder / "Pong" / "1" / "leapjax")  # a new conversion is equal
    assert first == {seed: identify(read(folder, 60, seed).demonstrations) for seed in range(6)}
    assert len({tuple(x) for x in first.values()}) > 1


def test_conversions_are_reused_until_shards_or_arguments_change(tmp_path, monkeypatch):
    store_shard(tmp_path, make_episodes([5, 6]))
    first = read(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(gzip, "open", None)  # unpacking now fails
        assert identify(read(tmp_path).demonstrations) == identify(first.demonstrations)
    changed = make_episodes([5, 6], seed=3)
    store_shard(tmp_path, changed)
    assert_same_episodes(read(tmp_path).demonstrations, changed)
    read(tmp_path, 3)
    read(tmp_path, seed=1)
    assert len(list_conversions(tmp_path)) == 4


def test_unfinished_and_damaged_conversions_are_never_used(tmp_path, monkeypatch):
    episodes = make_episodes([5, 6])
    store_shard(tmp_path, episodes)
    unfinished = tmp_path / "Pong" / "1" / "leapjax" / ".unfinished"  # of a killed process
    unfinished.mkdir(parents=True)
    (unfinished / "frames.npy").write_bytes(b"half")

    def full(*args, **kwargs):
        raise OSError("No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez", full)
        message = read_error(tmp_path)
    assert "No space left" in message and "make room" in message
    assert not list_conversions(tmp_path) and not unfinished.exists()
    assert_same_episodes(read(tmp_path).demonstrations, episodes)
    (path,) = list_conversions(tmp_path)
    path.write_bytes(path.read_bytes()[:5000])
    assert str(path.parent) in read_error(tmp_path)


def test_conversions_of_read_only_data_go_to_a_private_cache(tmp_path, monkeypatch):
    episodes = make_episodes([5, 6])
    data, cache = tmp_path / "data", tmp_path / "cache"
    store_shard(data, episodes)
    before = sorted(data.rglob("*"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(os, "access", lambda path, mode: data not in Path(path).parents)
    for _ in range(2):
        assert_same_episodes(read(data).demonstrations, episodes)
    assert sorted(data.rglob("*")) == before
    (path,) = cache.rglob("frames.npy")
    assert (cache / "leapjax").stat().st_mode & 0o077 == 0
    # A cache that others can write to raises an error.
    shared = cache / "leapjax" / "dqn-replay"
    shared.chmod(0o777)
    assert f"others can write to {shared}" in read_error(data)
    shared.chmod(0o700)
    if os.getuid() == 0:
        os.chown(path.parents[1], 1234, -1)
        assert f"{path.parents[1]} belongs to another user" in read_error(data)


def test_reading_never_holds_all_frames_in_memory(tmp_path):
    rows = add_stale(make_rows(make_episodes([1000, 1000])))
    for number in range(4):
        store_shard(tmp_path, rows, number)
    del rows
    read(tmp_path, 1, seed=7)  # imports and caches do not count
    tracemalloc.start()
    assert len(read(tmp_path, 1001).demonstrations) == 2
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1000 * 84 * 84 / 2  # half of an episode


def test_missing_folder_game_run_or_disk_space_raises_an_error(tmp_path, monkeypatch):
    message = read_error(tmp_path / "absent")
    assert "Pong/1/replay_logs" in message and "gs://atari-replay-datasets" in message
    store_shard(tmp_path, make_episodes([5]), dqn_seed=2)
    assert f"no data of Breakout in {tmp_path}, only of Pong" in read_error(
        tmp_path, GAMES["Breakout"]
    )
    assert f"no DQN of seed 1 of Pong in {tmp_path}, only 2" in read_error(tmp_path)
    monkeypatch.setattr(files, "SPARE", 2**60)
    assert "make room" in read_error(tmp_path, dqn_seed=2)


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("it was unpickled",)


def pickle_objects(content):
    file = io.BytesIO()
    np.save(file, np.array([Bomb()], object), allow_pickle=True)
    return gzip.compress(file.getvalue())


def claim_more_rows(content):
    """Makes a header that claims far more rows than the data have."""
    array = np.load(io.BytesIO(gzip.decompress(content)))
    file = io.BytesIO()
    write_header(file, array.dtype, (10**15, *array.shape[1:]))
    return gzip.compress(file.getvalue() + bytes(10))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda content: content[: len(content) // 2], "copy it again"),
        (lambda content: b"<html>Not found</html>", "Not a gzipped file"),
        (lambda content: gzip.compress(np.array([Bomb()], object).dumps()), "cannot read"),
        (pickle_objects, "holds object"),
        (lambda content: gzip.compress(gzip.decompress(content)[:-9]), "ends before its last row"),
        (claim_more_rows, "claims to hold 4000000000000000 bytes"),
        (lambda content: b"", "is empty"),
        (lambda content: None, "is missing"),
    ],
)
def test_damaged_files_raise_an_error(tmp_path, change, reason):
    logs = store_shard(tmp_path, make_episodes([50]))
    for part in READ if change is claim_more_rows else [ACTION]:  # the error names the first
        path = logs / f"{part}_ckpt.0.gz"
        changed = change(path.read_bytes())
        path.unlink() if changed is None else path.write_bytes(changed)
    message = read_error(tmp_path)
    assert f"{ACTION}_ckpt.0.gz" in message and reason in message and not list_conversions(tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("observation", lambda x: x[:, :42], "holds uint8 of shape (9, 42, 84)"),
        ("observation", lambda x: np.asfortranarray(x), "(9, 84, 84)"),
        ("action", lambda x: x.astype(np.int64), "action_ckpt.0.gz holds int64"),
        ("terminal", lambda x: x[0], "of shape ()"),
        ("action", lambda x: -x, "to 0, expected 0 to 5 of Pong"),
        ("action", lambda x: 9 * x, "another game or action set"),
        ("reward", lambda x: np.where(x, np.float32(np.inf), x), "rewards that are not finite"),
        ("reward", lambda x: x[:-1], "8 of reward"),
        ("terminal", lambda x: np.zeros_like(x), "no whole trajectory in"),
    ],
)
def test_unexpected_arrays_raise_an_error(tmp_path, name, change, reason):
    rows = add_stale(make_rows(make_episodes([5])))
    logs = store_shard(tmp_path, {**rows, name: change(rows[name])})
    message = read_error(tmp_path)
    assert str(logs) in message and reason in message


def test_written_shards_have_dopamines_format(tmp_path):
    episodes = make_episodes([4, 9])
    logs = replay.replay_logs(tmp_path, PONG, 1)
    replay.write_shard(logs, 0, [e._replace(rewards=e.rewards * 7) for e in episodes])
    assert_same_episodes(read(tmp_path).demonstrations, episodes)  # with rewards clipped to [-1, 1]
    assert replay.has_shard(logs, 0) and not replay.has_shard(logs, 3)
    arrays = {}
    for path in logs.iterdir():
        with gzip.open(path) as file:
            arrays[path.name] = np.load(file, allow_pickle=False)
            assert not file.read()
    assert arrays.pop("add_count_ckpt.0.gz") == 19
    np.testing.assert_array_equal(arrays.pop("invalid_range_ckpt.0.gz"), [18, 19, 0, 1, 2])
    for name, rows in make_rows(episodes).items():
        array = arrays.pop(f"$store$_{name}_ckpt.0.gz")
        assert array.dtype == STORED[name] and not array[-1].any()
        np.testing.assert_array_equal(array[:-1], rows)
    assert not arrays


@pytest.mark.parametrize("written_before", [False, True])
def test_killed_writer_leaves_no_shard(tmp_path, monkeypatch, written_before):
    if written_before:
        replay.write_shard(tmp_path, 0, make_episodes([4]))
    write, calls = writing._write_part, []

    def interrupt(*args):
        if len(calls) == 5 * (not written_before):
            raise KeyboardInterrupt
        calls.append(args)
        write(*args)

    monkeypatch.setattr(writing, "_write_part", interrupt)
    with pytest.raises(KeyboardInterrupt):
        replay.write_shard(tmp_path, 0, make_episodes([5, 6]))
    assert not replay.has_shard(tmp_path, 0)
