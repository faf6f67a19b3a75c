"""Reads a sample of whole trajectories from DQN-Replay: converts it once, then memory-maps it."""

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from leapjax import files
from leapjax.domain import Collection
from leapjax.domains.atari.games import Game
from leapjax.domains.atari.replay.conversion import convert, load_conversion
from leapjax.domains.atari.replay.shards import PARTS, find_logs, find_shards, part_path
from leapjax.domains.atari.replay.trajectories import choose_trajectories
from leapjax.errors import UserError

FORMAT = 1  # raise it whenever conversions change, so that old conversions are not used


def read(
    folder: Path,
    game: Game,
    transitions: int,
    seed: int,
    dqn_seed: int = 1,
    shards: Sequence[int] | None = None,
) -> Collection:
    """Samples whole trajectories nearly as the Decision Transformer's loader does.

    It visits a random shard at a time and takes up to ten trajectories, until there are enough
    transitions. The next visit to a shard continues where the last visit ended. The page
    docs/deviations.md lists the differences. The result leaves out padding. Data from other
    programs may have no padding. The first trajectory of a shard may then be incomplete, so it
    counts as cut.

    The first call unpacks the frames into a memory-mapped file beside the data, or in the user's
    cache folder if the data are read-only. Later calls with the same arguments only open this file,
    until a shard changes. A user may delete the file while no program uses it.

    Args:
        folder: folder of DQN-Replay, with a folder for each game.
        game: game to read.
        transitions: smallest number of transitions; if there are fewer, reads all.
        seed: seed of the sampling.
        dqn_seed: seed of the DQN that played; DQN-Replay has 1 to 5 of each game.
        shards: numbers of the shards to read; all by default.

    Returns:
        The trajectories, in the order of the visits, and the number of cut trajectories in the
        visited shards. The frames are views of the memory map. DQN-Replay does not store the frame
        after the last action, so the result repeats the frame before it. Only models that predict
        states learn from this frame, because the value after the end of an episode is 0.

    Raises:
        UserError: there are no data, or a visited shard is damaged or of another game; names the
            file.
    """
    if transitions < 1:
        raise UserError(f"transitions must be at least 1, got {transitions}")
    logs = find_logs(folder, game, dqn_seed)
    numbers = find_shards(logs, shards)
    key = _name_conversion(logs, numbers, transitions, seed)
    beside, cached = _find_places(logs.parent)
    if (beside / key).is_dir():
        return load_conversion(beside / key)
    place = beside
    if not _is_writable(beside):
        place = files.make_private(cached)  # so only this user can have made its content
        if (place / key).is_dir():
            return load_conversion(place / key)
    with files.lock_folder(place, wait=True):
        if not (place / key).is_dir():  # another process may have made it meanwhile
            convert(logs, choose_trajectories(logs, numbers, transitions, seed), game, place / key)
    return load_conversion(place / key)


def _name_conversion(logs: Path, numbers: list[int], transitions: int, seed: int) -> str:
    """Names a conversion by its arguments and the sizes and times of its files."""
    paths = (part_path(logs, part, number) for number in numbers for part in PARTS)
    states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    text = json.dumps([FORMAT, int(transitions), int(seed), states])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _find_places(folder: Path) -> tuple[Path, Path]:
    """Returns two folders for conversions: beside the data of a DQN, and in the user's cache."""
    name = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:16]
    return folder / "leapjax", files.find_cache_folder() / "dqn-replay" / name


def _is_writable(place: Path) -> bool:
    """Returns whether a folder, or its parent if it does not exist, can be written to."""
    return os.access(place if place.exists() else place.parent, os.W_OK)
