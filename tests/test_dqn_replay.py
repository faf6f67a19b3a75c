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


def episodes(lengths, seed: int = 0) -> list[Episode]:
    """Episodes whose frames tell every episode and every step apart."""
    return [_episode(length, 1000 * seed + i) for i, length in enumerate(lengths)]


def _episode(length: int, seed: int) -> Episode:
    rng = np.random.default_rng(seed)
    frames = np.zeros((length, 84, 84), np.uint8)
    frames[:, :4, :4] = rng.integers(1, 256, (length, 4, 4))
    frames[:, 0, 0] = np.arange(length) % 256
    rewards = rng.integers(-1, 2, length).astype(np.float32)
    return Episode(frames, rng.integers(0, 6, length, np.int32), rewards)


def rows_of(some, padding: int = 3) -> dict[str, np.ndarray]:
    """The rows of whole episodes as Dopamine's buffer adds them, without a last stale row."""
    columns: dict[str, list] = {name: [] for name in STORED}
    for e in some:
        columns["observation"] += [np.zeros((padding, 84, 84)), e.frames]
        columns["action"] += [np.zeros(padding), e.actions]
        columns["reward"] += [np.zeros(padding), e.rewards]
        columns["terminal"] += [np.zeros(padding + len(e.actions) - 1), np.ones(1)]
    return {
        name: np.concatenate(c, dtype=STORED[name], casting="unsafe") for name, c in columns.items()
    }


def stale(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """With a last row of an earlier pass of the buffer: as misleading as can be."""
    last = {"observation": np.full((1, 84, 84), 99), "action": [5], "reward": [1], "terminal": [1]}
    return {name: np.concatenate([x, np.asarray(last[name], x.dtype)]) for name, x in rows.items()}


def put(folder: Path, some, number: int = 0, dqn_seed: int = 1) -> Path:
    """Writes a shard of episodes, or of rows, with NumPy and gzip alone."""
    rows = some if isinstance(some, dict) else stale(rows_of(some))
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


def refused(folder: Path, game=PONG, **options) -> str:
    with pytest.raises(UserError) as raised:
        replay.read(folder, game, **{"transitions": 10**9, "seed": 0, **options})
    message = str(raised.value)
    assert "\n" not in message
    return message


def ids(demonstrations) -> list[bytes]:
    """What tells trajectories apart, whatever their order."""
    return [np.asarray(d.observations[:-1]).tobytes() for d in demonstrations]


def assert_are(demonstrations, expected) -> None:
    """They are these whole episodes, in some order."""
    assert len(demonstrations) == len(expected)
    by_frames = {e.frames.tobytes(): e for e in expected}
    for name, d in zip(ids(demonstrations), demonstrations, strict=True):
        e = by_frames.pop(name)
        np.testing.assert_array_equal(d.observations[-1], e.frames[-1])
        np.testing.assert_array_equal(d.actions, e.actions)
        np.testing.assert_array_equal(d.rewards, e.rewards)
        dtypes = (d.observations.dtype, d.actions.dtype, d.rewards.dtype)
        assert dtypes == (np.uint8, np.int32, np.float32)
        assert (d.terminated, d.truncated, d.seed) == (True, False, UNKNOWN_SEED)


def conversions(folder: Path) -> list[Path]:
    return sorted((folder / "Pong" / "1" / "leapjax").glob("*/frames.npy"))


@pytest.fixture(scope="module")
def three_shards(tmp_path_factory):
    """36 episodes of 3 to 14 steps in three shards: nobody writes to them."""
    folder = tmp_path_factory.mktemp("shards")
    every = [episodes(range(3, 15), seed=number) for number in range(3)]
    for number, some in enumerate(every):
        put(folder, some, number)
    return folder, [e for some in every for e in some]


def test_whole_trajectories_are_the_originals(three_shards):
    folder, originals = three_shards
    demonstrations, dropped = read(folder)
    assert_are(demonstrations, originals)
    assert not dropped
    # Their frames are views of one memory map.
    assert not demonstrations[0].observations.flags.writeable
    assert len({id(d.observations._mmap) for d in demonstrations}) == 1


def test_what_files_cut_is_left_out_and_counted(tmp_path):
    some = episodes([20, 30, 40, 50])
    # Before rows 10 and after row 133: in the middle of the first and of the last.
    put(tmp_path, stale({name: x[10:133] for name, x in rows_of(some).items()}))
    for _ in range(2):  # from the shards and from their conversion
        demonstrations, dropped = read(tmp_path)
        assert_are(demonstrations, some[1:3])
        assert dropped == {CUT_BEFORE: 1, CUT_AFTER: 1}


def test_a_last_row_is_never_used(tmp_path):
    some = episodes([5, 6])
    put(tmp_path, rows_of(some))  # the row that ends the second episode is the stale one
    demonstrations, dropped = read(tmp_path)
    assert_are(demonstrations, some[:1])
    assert dropped == {CUT_AFTER: 1}


@pytest.mark.parametrize("padding", [3, 0])
def test_black_frames_of_a_game_are_kept(tmp_path, padding):
    some = episodes([2, 3, 9, 1])
    for part in some[2]:
        part[:2] = 0  # nothing tells these from padding but that padding is three rows
    put(tmp_path, stale(rows_of(some, padding)))
    demonstrations, dropped = read(tmp_path)
    # Without padding nobody knows whether the first is whole.
    assert_are(demonstrations, some if padding else some[1:])
    assert dropped == ({} if padding else {CUT_BEFORE: 1})


def test_sampling_takes_ten_at_a_visit_where_the_last_one_ended_until_there_are_enough(
    three_shards,
):
    folder, originals = three_shards
    for wanted in (1, 30, 100):
        lengths = [len(d.actions) for d in read(folder, wanted).demonstrations]
        assert sum(lengths[:-1]) < wanted <= sum(lengths)
    found = ids(read(folder, seed=5).demonstrations)
    shards = [[e.frames.tobytes() for e in originals[at : at + 12]] for at in (0, 12, 24)]
    assert [[name for name in found if name in shard] for shard in shards] == shards
    assert any(set(found[:10]) < set(shard) for shard in shards)


def test_the_seed_decides(three_shards):
    folder, _ = three_shards
    first = {seed: ids(read(folder, 60, seed).demonstrations) for seed in range(6)}
    shutil.rmtree(folder / "Pong" / "1" / "leapjax")  # made again, it is the same
    assert first == {seed: ids(read(folder, 60, seed).demonstrations) for seed in range(6)}
    assert len({tuple(x) for x in first.values()}) > 1


def test_conversions_are_opened_again_unless_shards_or_arguments_changed(tmp_path, monkeypatch):
    put(tmp_path, episodes([5, 6]))
    first = read(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(gzip, "open", None)  # whoever unpacks anything now fails
        assert ids(read(tmp_path).demonstrations) == ids(first.demonstrations)
    changed = episodes([5, 6], seed=3)
    put(tmp_path, changed)
    assert_are(read(tmp_path).demonstrations, changed)
    read(tmp_path, 3)
    read(tmp_path, seed=1)
    assert len(conversions(tmp_path)) == 4


def test_an_unfinished_or_damaged_conversion_is_never_used(tmp_path, monkeypatch):
    some = episodes([5, 6])
    put(tmp_path, some)
    left = tmp_path / "Pong" / "1" / "leapjax" / ".unfinished"  # by a process that was killed
    left.mkdir(parents=True)
    (left / "frames.npy").write_bytes(b"half")

    def full(*args, **kwargs):
        raise OSError("No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez", full)
        message = refused(tmp_path)
    assert "No space left" in message and "make room" in message
    assert not conversions(tmp_path) and not left.exists()
    assert_are(read(tmp_path).demonstrations, some)
    (path,) = conversions(tmp_path)
    path.write_bytes(path.read_bytes()[:5000])
    assert str(path.parent) in refused(tmp_path)


def test_beside_read_only_data_nothing_is_written(tmp_path, monkeypatch):
    some = episodes([5, 6])
    data, cache = tmp_path / "data", tmp_path / "cache"
    put(data, some)
    before = sorted(data.rglob("*"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(os, "access", lambda path, mode: data not in Path(path).parents)
    for _ in range(2):
        assert_are(read(data).demonstrations, some)
    assert sorted(data.rglob("*")) == before
    (path,) = cache.rglob("frames.npy")
    assert (cache / "leapjax").stat().st_mode & 0o077 == 0
    # What others may have put there is not learned from.
    shared = cache / "leapjax" / "dqn-replay"
    shared.chmod(0o777)
    assert f"others can write to {shared}" in refused(data)
    shared.chmod(0o700)
    if os.getuid() == 0:
        os.chown(path.parents[1], 1234, -1)
        assert f"{path.parents[1]} belongs to another user" in refused(data)


def test_frames_are_never_all_in_memory(tmp_path):
    rows = stale(rows_of(episodes([1000, 1000])))
    for number in range(4):
        put(tmp_path, rows, number)
    del rows
    read(tmp_path, 1, seed=7)  # what is imported and kept for good is not of this
    tracemalloc.start()
    assert len(read(tmp_path, 1001).demonstrations) == 2
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1000 * 84 * 84 / 2  # not even one of the two was in memory as a whole


def test_no_such_folder_game_run_or_shard(tmp_path, monkeypatch):
    message = refused(tmp_path / "absent")
    assert "Pong/1/replay_logs" in message and "gs://atari-replay-datasets" in message
    put(tmp_path, episodes([5]), dqn_seed=2)
    assert f"no data of Breakout in {tmp_path}, only of Pong" in refused(
        tmp_path, GAMES["Breakout"]
    )
    assert f"no DQN of seed 1 of Pong in {tmp_path}, only 2" in refused(tmp_path)
    monkeypatch.setattr(files, "SPARE", 2**60)
    assert "make room" in refused(tmp_path, dqn_seed=2)


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("it was unpickled",)


def pickled(whole):
    file = io.BytesIO()
    np.save(file, np.array([Bomb()], object), allow_pickle=True)
    return gzip.compress(file.getvalue())


def claims(whole):
    """A header of far more rows than there are."""
    array = np.load(io.BytesIO(gzip.decompress(whole)))
    file = io.BytesIO()
    write_header(file, array.dtype, (10**15, *array.shape[1:]))
    return gzip.compress(file.getvalue() + bytes(10))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda whole: whole[: len(whole) // 2], "copy it again"),
        (lambda whole: b"<html>Not found</html>", "Not a gzipped file"),
        (lambda whole: gzip.compress(np.array([Bomb()], object).dumps()), "cannot read"),
        (pickled, "holds object"),
        (lambda whole: gzip.compress(gzip.decompress(whole)[:-9]), "ends before its last row"),
        (claims, "claims to hold 4000000000000000 bytes"),
        (lambda whole: b"", "is empty"),
        (lambda whole: None, "is missing"),
    ],
)
def test_a_part_that_is_damaged(tmp_path, change, said):
    logs = put(tmp_path, episodes([50]))
    for part in READ if change is claims else [ACTION]:  # of all parts the first is told
        path = logs / f"{part}_ckpt.0.gz"
        changed = change(path.read_bytes())
        path.unlink() if changed is None else path.write_bytes(changed)
    message = refused(tmp_path)
    assert f"{ACTION}_ckpt.0.gz" in message and said in message and not conversions(tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "said"),
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
def test_arrays_of_another_kind(tmp_path, name, change, said):
    rows = stale(rows_of(episodes([5])))
    logs = put(tmp_path, {**rows, name: change(rows[name])})
    message = refused(tmp_path)
    assert str(logs) in message and said in message


def test_what_is_written_is_in_the_format(tmp_path):
    some = episodes([4, 9])
    logs = replay.replay_logs(tmp_path, PONG, 1)
    replay.write_shard(logs, 0, [e._replace(rewards=e.rewards * 7) for e in some])
    assert_are(read(tmp_path).demonstrations, some)  # whose rewards are within [-1, 1]
    assert replay.has_shard(logs, 0) and not replay.has_shard(logs, 3)
    arrays = {}
    for path in logs.iterdir():
        with gzip.open(path) as file:
            arrays[path.name] = np.load(file, allow_pickle=False)
            assert not file.read()
    assert arrays.pop("add_count_ckpt.0.gz") == 19
    np.testing.assert_array_equal(arrays.pop("invalid_range_ckpt.0.gz"), [18, 19, 0, 1, 2])
    for name, rows in rows_of(some).items():
        array = arrays.pop(f"$store$_{name}_ckpt.0.gz")
        assert array.dtype == STORED[name] and not array[-1].any()
        np.testing.assert_array_equal(array[:-1], rows)
    assert not arrays


@pytest.mark.parametrize("written_before", [False, True])
def test_a_writer_that_is_killed_leaves_no_shard(tmp_path, monkeypatch, written_before):
    if written_before:
        replay.write_shard(tmp_path, 0, episodes([4]))
    write, calls = writing._write_part, []

    def killed(*args):
        if len(calls) == 5 * (not written_before):
            raise KeyboardInterrupt
        calls.append(args)
        write(*args)

    monkeypatch.setattr(writing, "_write_part", killed)
    with pytest.raises(KeyboardInterrupt):
        replay.write_shard(tmp_path, 0, episodes([5, 6]))
    assert not replay.has_shard(tmp_path, 0)
