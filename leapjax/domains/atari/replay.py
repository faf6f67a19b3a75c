"""DQN-Replay: games as Dopamine's replay buffer kept them, read as whole trajectories.

A run of a game is a folder of shards; shard N is six files, each a gzip of one `.npy`
(Agarwal et al., 2020: 50 shards of 1,000,000 rows R):

    $store$_observation_ckpt.N.gz  [R, 84, 84] uint8: the frame before each action
    $store$_action_ckpt.N.gz       [R] int32
    $store$_reward_ckpt.N.gz       [R] float32, clipped to [-1, 1]
    $store$_terminal_ckpt.N.gz     [R] uint8: the episode ended with this action
    add_count_ckpt.N.gz, invalid_range_ckpt.N.gz: the buffer's own, which nothing here reads

Three rows of zeros, the padding, come before every episode. The last row is not of this shard:
the buffer is circular, and that row had not been written again yet. An episode may go on from
one shard to the next, where neither holds the whole of it.
"""

import contextlib
import gzip
import hashlib
import itertools
import json
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from leapjax import files
from leapjax.checks import check_seed
from leapjax.data.storage import UNKNOWN_SEED
from leapjax.domain import Collection
from leapjax.domains.atari.games import GAMES, HEIGHT, WIDTH, Game
from leapjax.errors import UserError, first_line
from leapjax.types import Demonstration

PADDING = 3  # rows before each episode
TRAJECTORIES_PER_VISIT = 10  # what the Decision Transformer's loader is told; it takes one more
CUT_BEFORE, CUT_AFTER = "cut by the beginning of a file", "cut by the end of a file"

_STORED: dict[str, tuple[np.dtype, tuple[int, ...]]] = {  # by name: the type, the shape of a row
    "action": (np.dtype(np.int32), ()),
    "reward": (np.dtype(np.float32), ()),
    "terminal": (np.dtype(np.uint8), ()),
    "observation": (np.dtype(np.uint8), (HEIGHT, WIDTH)),
}
# The largest comes last: a shard that has it has everything.
_PARTS = tuple(f"$store$_{name}" for name in _STORED)

_BLOCK = 2**19  # bytes that are unpacked at once
_LEVEL = 4  # of gzip's compression: twice as fast as the default, and hardly larger
_EXPANSION = 1032  # bytes that gzip can make of one, at most
_FORMAT = 1  # raised whenever what a conversion holds changes: old ones are then unused
_FRAMES, _STEPS, _UNFINISHED = "frames.npy", "steps.npz", ".unfinished"


class Episode(NamedTuple):
    """One game of n steps, played until it was over or cut off.

    The format has one mark for both, which is learned from as an end.
    """

    frames: np.ndarray  # [n, 84, 84] uint8: before each action
    actions: np.ndarray  # [n] int32
    rewards: np.ndarray  # [n] float32


def replay_logs(folder: Path, game: Game, run: int) -> Path:
    """The folder of a run's shards."""
    return folder / game.name / str(run) / "replay_logs"


def has_shard(folder: Path, number: int) -> bool:
    """Whether all parts of a shard are in a folder."""
    return all(_part(folder, part, number).is_file() for part in _PARTS)


def write_shard(folder: Path, number: int, episodes: Sequence[Episode]) -> None:
    """Writes episodes as one shard; a killed program leaves none that seems whole.

    Rewards are clipped, and a last row of zeros takes the place of the row that nobody uses.

    Args:
        folder: of the run's shards, see `replay_logs`; made if it is not there.
        number: of the shard; one that is there already is replaced.
        episodes: at least one.

    Raises:
        ValueError: the arrays of an episode are not of one length, or of other frames.
        UserError: they cannot be written, for example because the disk is full.
    """
    for episode in episodes:
        n = len(episode.actions)
        shapes = [np.shape(part) for part in episode]
        if n == 0 or shapes != [(n, HEIGHT, WIDTH), (n,), (n,)]:
            raise ValueError(f"an episode of {n} steps with arrays of the shapes {shapes}")
    if not episodes:
        raise ValueError("a shard needs at least one episode")
    columns: dict[str, Iterable[np.ndarray]] = {
        "action": (e.actions for e in episodes),
        "reward": (np.clip(e.rewards, -1, 1) for e in episodes),
        "terminal": (np.arange(len(e.actions)) == len(e.actions) - 1 for e in episodes),
        "observation": (e.frames for e in episodes),
    }
    added = sum(PADDING + len(e.actions) for e in episodes)
    # What Dopamine keeps for stacks of four frames: one row before the next to write, four on.
    invalid = (added - 1 + np.arange(PADDING + 2)) % (added + 1)
    # Without frames it is no shard any more: old parts and new ones are never taken for one.
    with contextlib.suppress(OSError):  # not there; or not to be written to, which is said below
        _part(folder, "$store$_observation", number).unlink()
    for part, array in (("add_count", np.array(added)), ("invalid_range", invalid)):
        _write(_part(folder, part, number), array.dtype, array.shape, [array])
    for name, values in columns.items():
        dtype, shape = _STORED[name]
        blocks = _padded(values, dtype, shape)
        _write(_part(folder, f"$store$_{name}", number), dtype, (added + 1, *shape), blocks)


def _padded(
    values: Iterable[np.ndarray], dtype: np.dtype, shape: tuple[int, ...]
) -> Iterator[np.ndarray]:
    """The rows of a part of a shard."""
    zeros = np.zeros((PADDING, *shape), dtype)
    for value in values:
        yield zeros
        yield np.ascontiguousarray(value, dtype)
    yield zeros[:1]


def _write(
    path: Path, dtype: np.dtype, shape: tuple[int, ...], blocks: Iterable[np.ndarray]
) -> None:
    with (
        files.whole(path) as scratch,
        scratch.open("wb") as raw,
        gzip.GzipFile("", "wb", _LEVEL, raw, mtime=0) as file,  # the same bytes at any time
    ):
        _write_header(file, dtype, shape)
        for block in blocks:
            file.write(block.data)


def _write_header(file: IO[bytes] | gzip.GzipFile, dtype: np.dtype, shape: tuple[int, ...]) -> None:
    """The header of a `.npy`; as NumPy writes it, it is as long for any number of rows."""
    descr = np.lib.format.dtype_to_descr(dtype)
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)


def read(
    folder: Path,
    game: Game,
    transitions: int,
    seed: int,
    run: int = 1,
    shards: Sequence[int] | None = None,
) -> Collection:
    """Samples whole trajectories nearly as the Decision Transformer's loader does.

    A random shard at a time gives up to ten trajectories, from where it was left before, until
    there are enough; docs/deviations.md says what differs. Padding is left out wherever it is: a
    maker of data may write none, but then nobody knows whether the first trajectory of a shard is
    whole, and it counts as cut.

    The frames are unpacked once, into a memory-mapped file beside the data (in this user's cache
    folder, where that is read-only). A later call with the same arguments only opens it, until
    a shard is changed. What was converted may be deleted whenever nobody uses it.

    Args:
        folder: of DQN-Replay, with a folder for each game.
        game: of which to read.
        transitions: so many at least, or all there are.
        seed: of the sampling.
        run: of the five that DQN-Replay has of each game.
        shards: numbers of those to read; None for all that are there.

    Returns:
        The trajectories, in the order of the visits, and how many were cut in the shards that
        were visited. Their frames are views of the memory map. The frame after the last action
        is the one before it again, which DQN-Replay does not hold. Only what predicts states
        learns from it; the value of a state after the end is 0 to all others.

    Raises:
        UserError: nothing there, or a shard that was visited is damaged or of another game;
            names the file.
    """
    if transitions < 1:
        raise UserError(f"transitions must be at least 1, got {transitions}")
    logs = _existing_logs(folder, game, run)
    numbers = _complete_shards(logs, shards)
    key = _key(logs, numbers, transitions, seed)
    beside, cached = _places(logs.parent)
    if (beside / key).is_dir():
        return _load(beside / key)
    place = beside
    if not _is_writable(beside):
        files.make_private(cached)  # what is there already was made by this user alone
        place = cached
        if (place / key).is_dir():
            return _load(place / key)
    with files.only_process_in(place, wait=True):
        if not (place / key).is_dir():  # another process may have made it meanwhile
            _convert(logs, _choose(logs, numbers, transitions, seed), game, place / key)
    return _load(place / key)


def _part(logs: Path, part: str, number: int) -> Path:
    return logs / f"{part}_ckpt.{number}.gz"


def _existing_logs(folder: Path, game: Game, run: int) -> Path:
    logs = replay_logs(folder, game, run)
    if logs.is_dir():
        return logs
    other = "" if run == 1 else f" --replay-run {run}"
    expected = (
        f"expected the shards of DQN-Replay in {logs}: copy them from "
        "gs://atari-replay-datasets, or make such data with "
        f"`python -m experiments.atari collect --game {game.name}{other}`"
    )
    if not folder.is_dir():
        raise UserError(f"no folder {folder}; {expected}")
    if not (folder / game.name).is_dir():
        others = [name for name in GAMES if (folder / name).is_dir()]
        only = f", only of {', '.join(others)}" if others else ""
        raise UserError(f"no data of {game.name} in {folder}{only}; {expected}")
    runs = sorted(path.parent.name for path in (folder / game.name).glob("*/replay_logs"))
    only = f", only {', '.join(runs)}" if runs else ""
    raise UserError(f"no run {run} of {game.name} in {folder}{only}; {expected}")


def _complete_shards(logs: Path, wanted: Sequence[int] | None) -> list[int]:
    """The numbers of the shards in a folder, or of those that are wanted.

    Raises:
        UserError: there are none, or a part of one is missing or empty.
    """
    pattern = rf"(?:{'|'.join(map(re.escape, _PARTS))})_ckpt\.(\d+)\.gz"
    found = (re.fullmatch(pattern, path.name) for path in logs.iterdir())
    numbers = sorted({int(match[1]) for match in found if match} if wanted is None else wanted)
    if not numbers:
        raise UserError(
            f"no shards in {logs}: expected files such as {_part(logs, _PARTS[-1], 0).name}"
        )
    again = "copy it again, or delete the other parts of its shard"
    for path in (_part(logs, part, number) for number in numbers for part in _PARTS):
        if not path.is_file():
            raise UserError(f"{path} is missing, but other parts of its shard are there: {again}")
        if path.stat().st_size == 0:
            raise UserError(f"{path} is empty: {again}")
    return numbers


def _key(logs: Path, numbers: list[int], transitions: int, seed: int) -> str:
    """A name for a conversion: another one whenever a file was changed."""
    paths = (_part(logs, part, number) for number in numbers for part in _PARTS)
    states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    text = json.dumps([_FORMAT, int(transitions), int(seed), states])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _places(run: Path) -> tuple[Path, Path]:
    """Where conversions of a run may be: beside the data, or in this user's cache folder."""
    name = hashlib.sha256(os.fsencode(run.resolve())).hexdigest()[:16]
    return run / "leapjax", files.cache_folder() / "dqn-replay" / name


def _is_writable(place: Path) -> bool:
    return os.access(place if place.exists() else place.parent, os.W_OK)


class _Array(NamedTuple):
    """An array that is unpacked from its first row to its last."""

    path: Path
    file: gzip.GzipFile  # at the next row
    dtype: np.dtype
    shape: tuple[int, ...]  # of a row
    rows: int


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # noqa: BLE001  (gzip, zlib and NumPy raise many kinds)
        raise UserError(
            f"cannot read {path} ({first_line(error)}): expected a gzip of a NumPy array, copy it "
            "again or delete all parts of its shard"
        ) from None


@contextlib.contextmanager
def _open(logs: Path, number: int, name: str) -> Iterator[_Array]:
    """Opens a part of a shard, and reads no more of it than what it says of itself."""
    path = _part(logs, f"$store$_{name}", number)
    dtype, row = _STORED[name]
    with contextlib.ExitStack() as stack:
        with _reading(path):
            file = stack.enter_context(gzip.open(path))
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError("not of version 1.0")
            shape, fortran, found = np.lib.format.read_array_header_1_0(file)
        if found != dtype or len(shape) == 0 or shape[1:] != row or fortran:
            expected = ", ".join(map(str, ("R", *row)))
            raise UserError(
                f"{path} holds {found} of shape {shape}, expected {dtype} of shape [{expected}]: "
                "it is not of DQN-Replay"
            )
        claimed, room = dtype.itemsize * math.prod(shape), _EXPANSION * path.stat().st_size
        if claimed > room:
            raise UserError(
                f"{path} claims to hold {claimed} bytes, and has room for {room}: copy it again or "
                "delete all parts of its shard"
            )
        yield _Array(path, file, dtype, row, shape[0])


def _blocks(array: _Array, rows: int) -> Iterator[np.ndarray]:
    """The next rows of an array, a few at a time: [<= a block's worth, ...]."""
    size = array.dtype.itemsize * math.prod(array.shape)
    while rows > 0:
        count = min(rows, max(1, _BLOCK // size))
        with _reading(array.path):
            data = array.file.read(count * size)
            if len(data) < count * size:
                raise EOFError("it ends before its last row")
        yield np.frombuffer(data, array.dtype).reshape(count, *array.shape)
        rows -= count


def _take(array: _Array, rows: int) -> np.ndarray:
    """The next rows of an array, at once: [rows, ...]."""
    return np.concatenate([np.empty((0, *array.shape), array.dtype), *_blocks(array, rows)])


def _is_padding(*rows: np.ndarray) -> bool:
    """Whether the first rows of an episode are its padding, by all that is stored of them.

    All three or none: one black frame may well be of the game.
    """
    return all(len(x) == PADDING and not x.any() for x in rows)


class _Span(NamedTuple):
    """A whole trajectory, with its padding if it has any."""

    shard: int
    start: int  # its first row
    end: int  # the row after its last


def _whole_trajectories(logs: Path, number: int) -> tuple[list[_Span], Counter[str]]:
    """Those of a shard; and how many are not whole, by the reason."""
    with contextlib.ExitStack() as stack:
        arrays = {name: stack.enter_context(_open(logs, number, name)) for name in _STORED}
        rows = {name: array.rows for name, array in arrays.items()}
        if len(set(rows.values())) > 1:
            lengths = ", ".join(f"{count} of {name}" for name, count in rows.items())
            raise UserError(
                f"the parts of shard {number} in {logs} are of unequal lengths ({lengths} in "
                f"{arrays['observation'].path.name} and so on): copy them again"
            )
        # Its last row is of another time.
        terminal = _take(arrays["terminal"], rows["terminal"])[:-1]
        head = [
            _take(arrays[name], min(PADDING, len(terminal)))
            for name in ("action", "reward", "observation")
        ]
    borders = [0, *(np.flatnonzero(terminal) + 1).tolist()]
    spans = [_Span(number, *borders) for borders in itertools.pairwise(borders)]
    dropped: Counter[str] = Counter()
    if spans and not _is_padding(*head, terminal[:PADDING]):
        spans = spans[1:]
        dropped[CUT_BEFORE] += 1
    if len(terminal) - borders[-1] > PADDING:  # fewer are the padding of the next episode
        dropped[CUT_AFTER] += 1
    return spans, dropped


class _Choice(NamedTuple):
    """What is to be converted."""

    spans: list[_Span]  # in the order of the visits
    dropped: Counter[str]  # trajectories of the visited shards that are not whole


def _choose(logs: Path, numbers: list[int], transitions: int, seed: int) -> _Choice:
    """Decides which trajectories to take, without unpacking their frames.

    Raises:
        UserError: there are none.
    """
    rng = np.random.default_rng(check_seed(seed))
    left, waiting = list(numbers), dict[int, list[_Span]]()
    chosen, dropped, total = list[_Span](), Counter[str](), 0
    while left and total < transitions:
        number = left[rng.integers(len(left))]
        if number not in waiting:
            waiting[number], cut = _whole_trajectories(logs, number)
            dropped.update(cut)
        for _ in range(TRAJECTORIES_PER_VISIT):
            if total >= transitions or not waiting[number]:
                break
            span = waiting[number].pop(0)
            total += span.end - span.start - PADDING  # or more, if it has none
            chosen.append(span)
        if not waiting[number]:
            left.remove(number)
    if not chosen:
        only = f", only {', '.join(f'{n} {why}' for why, n in dropped.items())}" if dropped else ""
        raise UserError(f"no whole trajectory in {logs}{only}: copy or collect more shards")
    return _Choice(chosen, dropped)


def _convert(logs: Path, choice: _Choice, game: Game, target: Path) -> None:
    """Unpacks what was chosen into a new folder, which is there when it is whole."""
    spans = sorted(choice.spans)  # so that every shard is read once, from its beginning on
    most = sum(span.end - span.start + 1 for span in spans)
    files.check_room(target.parent, most * HEIGHT * WIDTH)
    scratch = target.parent / _UNFINISHED
    shutil.rmtree(scratch, ignore_errors=True)  # of a program that was killed
    try:
        scratch.mkdir()
        with (scratch / _FRAMES).open("wb") as out:
            _write_header(out, np.dtype(np.uint8), (0, HEIGHT, WIDTH))
            steps = [
                step
                for _, of_shard in itertools.groupby(spans, lambda span: span.shard)
                for step in _unpack(logs, list(of_shard), game, out)
            ]
            lengths = [len(actions) for actions, _ in steps]
            out.seek(0)
            _write_header(out, np.dtype(np.uint8), (sum(lengths) + len(lengths), HEIGHT, WIDTH))
        place = {span: index for index, span in enumerate(spans)}
        np.savez(
            scratch / _STEPS,
            actions=np.concatenate([actions for actions, _ in steps]),
            rewards=np.concatenate([rewards for _, rewards in steps]),
            lengths=lengths,
            order=[place[span] for span in choice.spans],
            reasons=np.array(list(choice.dropped), np.str_),
            counts=np.array(list(choice.dropped.values()), np.int64),
        )
        for path in (scratch / _FRAMES, scratch / _STEPS, scratch):
            files.flush(path)
        scratch.rename(target)
        files.flush(target.parent)
    except OSError as error:
        raise UserError(
            f"cannot write to {target.parent} ({first_line(error)}): make room there"
        ) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _unpack(
    logs: Path, spans: list[_Span], game: Game, out: IO[bytes]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Copies the frames of one shard's trajectories, [n + 1, 84, 84] each, to a file.

    Yields:
        The actions [n] and the rewards [n] of each.
    """
    number, first, last = spans[0].shard, spans[0].start, spans[-1].end
    with _open(logs, number, "action") as array:
        actions = _take(array, last)
        low, high = actions[first:].min(), actions[first:].max()
        if low < 0 or high >= len(game.actions):
            raise UserError(
                f"{array.path}: actions run from {low} to {high}, expected 0 to "
                f"{len(game.actions) - 1} of {game.name}: it is of another game or action set"
            )
    with _open(logs, number, "reward") as array:
        rewards = _take(array, last)
        if not np.isfinite(rewards[first:]).all():
            raise UserError(f"{array.path}: rewards that are not finite: copy it again")
    with _open(logs, number, "observation") as array:
        for _ in _blocks(array, first):
            pass
        for _, start, end in spans:  # one after the other, without gaps
            head = _take(array, min(PADDING, end - start))
            rows = slice(start, min(start + PADDING, end - 1))  # padding ends no episode
            padded = _is_padding(actions[rows], rewards[rows], head)
            rest = _blocks(array, end - start - len(head))
            for block in rest if padded else itertools.chain([head], rest):
                out.write(block.data)
            out.write(block[-1].data)
            start += PADDING if padded else 0
            yield actions[start:end].copy(), rewards[start:end].copy()


def _load(folder: Path) -> Collection:
    """Opens a conversion."""
    try:
        frames = np.load(folder / _FRAMES, mmap_mode="r", allow_pickle=False)
        if max(files.read_sizes(folder / _STEPS).values()) > 2**16 + frames.nbytes:
            raise ValueError("more steps than frames")
        with np.load(folder / _STEPS, allow_pickle=False) as stored:
            steps = dict(stored)
        lengths = steps["lengths"]
        if frames.shape != (lengths.sum() + len(lengths), HEIGHT, WIDTH):
            raise ValueError(f"frames of shape {frames.shape}")
        ends = lengths.cumsum()
        demonstrations = [
            Demonstration(
                frames[ends[i] - lengths[i] + i : ends[i] + i + 1],
                steps["actions"][ends[i] - lengths[i] : ends[i]],
                steps["rewards"][ends[i] - lengths[i] : ends[i]],
                True,
                False,
                UNKNOWN_SEED,
            )
            for i in steps["order"]
        ]
        reasons, counts = steps["reasons"].tolist(), steps["counts"].tolist()
        return Collection(demonstrations, dict(zip(reasons, counts, strict=True)))
    except Exception as error:  # noqa: BLE001  (NumPy raises many kinds)
        raise UserError(
            f"cannot read {folder} ({first_line(error)}): delete it and it is made again"
        ) from None
