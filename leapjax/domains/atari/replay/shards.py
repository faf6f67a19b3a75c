"""The files of DQN-Replay: the parts of a shard, and their paths."""

import gzip
import re
from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from leapjax.domains.atari.games import GAMES, HEIGHT, WIDTH, Game
from leapjax.errors import UserError

PADDING = 3  # rows before each episode
STORED: dict[str, tuple[np.dtype, tuple[int, ...]]] = {  # type and shape of a row, by name
    "action": (np.dtype(np.int32), ()),
    "reward": (np.dtype(np.float32), ()),
    "terminal": (np.dtype(np.uint8), ()),
    "observation": (np.dtype(np.uint8), (HEIGHT, WIDTH)),
}
# The largest part is written last, so a shard that has it is complete.
PARTS = tuple(f"$store$_{name}" for name in STORED)


class Episode(NamedTuple):
    """One game of n steps, played until it was over or cut off.

    The format does not tell these two cases apart, so agents learn both as an end.

    Attributes:
        frames: frames `[n, 84, 84]` uint8 before each action.
        actions: actions `[n]` int32.
        rewards: rewards `[n]` float32.
    """

    frames: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray


def replay_logs(folder: Path, game: Game, dqn_seed: int) -> Path:
    """Returns the folder of the shards of one DQN."""
    return folder / game.name / str(dqn_seed) / "replay_logs"


def has_shard(folder: Path, number: int) -> bool:
    """Returns whether all parts of a shard are in a folder."""
    return all(part_path(folder, part, number).is_file() for part in PARTS)


def part_path(logs: Path, part: str, number: int) -> Path:
    """Returns the path of a part of a shard."""
    return logs / f"{part}_ckpt.{number}.gz"


def find_logs(folder: Path, game: Game, dqn_seed: int) -> Path:
    """Finds the folder of the shards of one DQN.

    Raises:
        UserError: the folder does not exist; names existing data, and says how to get others.
    """
    logs = replay_logs(folder, game, dqn_seed)
    if logs.is_dir():
        return logs
    expected = (
        f"expected the shards of DQN-Replay in {logs}: copy them from "
        "gs://atari-replay-datasets, or make such data with "
        "leapjax.domains.atari.demonstrators.collect"
    )
    if not folder.is_dir():
        raise UserError(f"no folder {folder}; {expected}")
    if not (folder / game.name).is_dir():
        others = [name for name in GAMES if (folder / name).is_dir()]
        only = f", only of {', '.join(others)}" if others else ""
        raise UserError(f"no data of {game.name} in {folder}{only}; {expected}")
    seeds = sorted(path.parent.name for path in (folder / game.name).glob("*/replay_logs"))
    only = f", only {', '.join(seeds)}" if seeds else ""
    raise UserError(
        f"no DQN of seed {dqn_seed} of {game.name} in {folder}{only}; {expected}", "dqn_seed"
    )


def find_shards(logs: Path, chosen: Sequence[int] | None) -> list[int]:
    """Returns the numbers of the shards in a folder, and checks their files.

    Args:
        logs: folder of the shards.
        chosen: numbers of the shards to check; all in the folder by default.

    Raises:
        UserError: there are no shards, or a part of a shard is missing or empty.
    """
    pattern = rf"(?:{'|'.join(map(re.escape, PARTS))})_ckpt\.(\d+)\.gz"
    found = (re.fullmatch(pattern, path.name) for path in logs.iterdir())
    numbers = sorted({int(match[1]) for match in found if match} if chosen is None else chosen)
    if not numbers:
        raise UserError(
            f"no shards in {logs}: expected files such as {part_path(logs, PARTS[-1], 0).name}"
        )
    again = "copy it again, or delete the other parts of its shard"
    for path in (part_path(logs, part, number) for number in numbers for part in PARTS):
        if not path.is_file():
            raise UserError(f"{path} is missing, but other parts of its shard are there: {again}")
        if path.stat().st_size == 0:
            raise UserError(f"{path} is empty: {again}")
    return numbers


def write_header(file: IO[bytes] | gzip.GzipFile, dtype: np.dtype, shape: tuple[int, ...]) -> None:
    """Writes the header of a `.npy`; the header's length does not depend on the number of rows."""
    descr = np.lib.format.dtype_to_descr(dtype)
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
