"""Writes episodes as a shard of DQN-Replay."""

import contextlib
import gzip
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from leapjax import files
from leapjax.domains.atari.games import HEIGHT, WIDTH
from leapjax.domains.atari.replay.shards import (
    PADDING,
    STORED,
    Episode,
    part_path,
    write_header,
)

_LEVEL = 4  # gzip level: twice as fast as the default, with hardly larger files


def write_shard(folder: Path, number: int, episodes: Sequence[Episode]) -> None:
    """Writes episodes as a shard; a killed program leaves no shard that seems complete.

    Clips the rewards, and adds a row of zeros in place of the last row, which is not read.

    Args:
        folder: folder of a DQN's shards, see `replay_logs`; made if it does not exist.
        number: number of the shard; replaces an existing shard.
        episodes: episodes to write, at least one.

    Raises:
        ValueError: there are no episodes, an episode has no steps, its arrays differ in length, or
            its frames are not `[84, 84]`.
        UserError: the files cannot be written, for example because the disk is full.
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
    # Dopamine's range for stacks of four frames: the row before the next row to write, and four on.
    invalid = (added - 1 + np.arange(PADDING + 2)) % (added + 1)
    # Remove the frames first, so that old and new parts never look like a complete shard.
    with contextlib.suppress(OSError):  # missing, or not writable, which the writes below report
        part_path(folder, "$store$_observation", number).unlink()
    for part, array in (("add_count", np.array(added)), ("invalid_range", invalid)):
        _write_part(part_path(folder, part, number), array.dtype, array.shape, [array])
    for name, values in columns.items():
        dtype, shape = STORED[name]
        blocks = _pad(values, dtype, shape)
        _write_part(
            part_path(folder, f"$store$_{name}", number), dtype, (added + 1, *shape), blocks
        )


def _pad(
    values: Iterable[np.ndarray], dtype: np.dtype, shape: tuple[int, ...]
) -> Iterator[np.ndarray]:
    """Yields the rows of a part of a shard, with padding before each episode."""
    zeros = np.zeros((PADDING, *shape), dtype)
    for value in values:
        yield zeros
        yield np.ascontiguousarray(value, dtype)
    yield zeros[:1]


def _write_part(
    path: Path, dtype: np.dtype, shape: tuple[int, ...], blocks: Iterable[np.ndarray]
) -> None:
    """Writes a part of a shard, atomically."""
    with (
        files.write_whole(path) as scratch,
        scratch.open("wb") as raw,
        gzip.GzipFile("", "wb", _LEVEL, raw, mtime=0) as file,  # the same bytes at any time
    ):
        write_header(file, dtype, shape)
        for block in blocks:
            file.write(block.data)
