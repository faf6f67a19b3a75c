"""Reads a sample of whole trajectories from DQN-Replay, converted once and then memory-mapped."""

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

FORMAT = 1  # raise it whenever the content of a conversion changes: old ones are then unused


def read(
    folder: Path,
    game: Game,
    transitions: int,
    seed: int,
    dqn_seed: int = 1,
    shards: Sequence[int] | None = None,
) -> Collection:
    """Samples whole trajectories nearly as the Decision Transformer's loader does.

    A random shard at a time gives up to ten trajectories, from where the last visit ended, until
    there are enough; docs/deviations.md lists the differences. Padding is left out. Data of other
    makers may lack it; then the first trajectory of a shard may be cut, and counts as cut.

    The frames are unpacked once into a memory-mapped file beside the data, or in the user's cache
    folder if the data are read-only. Until a shard changes, later calls with the same arguments
    only open it. It may be deleted whenever no program uses it.

    Args:
        folder: of DQN-Replay, with a folder for each game.
        game: to read.
        transitions: smallest number of transitions; all, if there are fewer.
        seed: of the sampling.
        dqn_seed: seed of the DQN that played; DQN-Replay has 1 to 5 of each game.
        shards: numbers of the shards to read; all by default.

    Returns:
        The trajectories, in the order of the visits, and the number of cut trajectories in the
        visited shards. The frames are views of the memory map. DQN-Replay does not store the
        frame after the last action; the frame before it stands there twice. Only models that
        predict states learn from it: elsewhere the value after the end is 0.

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
        files.make_private(cached)  # this user alone made its content
        place = cached
        if (place / key).is_dir():
            return load_conversion(place / key)
    with files.lock_folder(place, wait=True):
        if not (place / key).is_dir():  # another process may have made it meanwhile
            convert(logs, choose_trajectories(logs, numbers, transitions, seed), game, place / key)
    return load_conversion(place / key)


def _name_conversion(logs: Path, numbers: list[int], transitions: int, seed: int) -> str:
    """Returns a name for a conversion, which changes whenever a file changes."""
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
