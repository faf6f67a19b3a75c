"""Plays games and writes them in the format of DQN-Replay, without a download.

A file holds one or more games. Its content does not depend on the other files, so data do not
depend on the number of processes or on interruptions.
"""

import itertools
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import Future
from importlib import metadata
from pathlib import Path
from typing import Any

from leapjax import files
from leapjax.data.seeds import TRAINING_START, TRAINING_STRIDE
from leapjax.domains.atari import replay
from leapjax.domains.atari.demonstrators import playing
from leapjax.domains.atari.demonstrators.manifests import (
    Manifest,
    count_transitions,
    manifest_path,
    read_manifest,
    read_manifests,
)
from leapjax.domains.atari.demonstrators.workers import is_finished, start_workers
from leapjax.domains.atari.games import Game, find_game
from leapjax.errors import UserError

# Smallest number of transitions in a file. A killed program loses the unfinished file of each core:
# at most these transitions and one more game.
SHARD = 1_000
GAMES = 1_000  # most games of a file
BYTES = 200  # approximate size of a transition on the disk
POLL = 0.2  # seconds
MARK = ".made-by-leapjax"  # marks a folder whose files may be replaced


def collect(
    folder: Path,
    game: Game,
    transitions: int,
    dqn_seed: int,
    longest: int,
    workers: int | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Manifest]:
    """Plays games until a folder holds enough transitions; resumes if it was stopped.

    Args:
        folder: folder of all games.
        game: game to play.
        transitions: smallest number of transitions, in whole games.
        dqn_seed: number from 1 in the name of the folder, as in DQN-Replay; each number has its own
            games.
        longest: decisions after which a game is cut off, see `replay.Episode`.
        workers: number of processes; by default the number of cores.
        progress: function to call with the number of transitions so far.

    Returns:
        The manifest of each file: its games, with their scores.

    Raises:
        UserError: the folder holds files that were not made here, of another game, of another
            length or by another demonstrator, or a process died.
    """
    logs = replay.replay_logs(folder, game, dqn_seed)
    workers = workers or len(os.sched_getaffinity(0))
    with files.lock_folder(logs):
        _claim(logs)
        files.check_room(logs, transitions * BYTES)
        made = read_manifests(folder, game, dqn_seed, transitions, longest)
        if count_transitions(made) < transitions:  # otherwise start no process
            waiting = (
                n
                for n in itertools.count()
                if read_manifest(folder, game, dqn_seed, n, longest) is None
            )
            with start_workers(workers) as pool:
                running: list[Future[Manifest]] = []
                while count_transitions(made) < transitions:
                    running = [each for each in running if not is_finished(each)]
                    for _ in range(workers - len(running)):
                        shard = folder, game.name, dqn_seed, next(waiting), longest
                        running.append(pool.submit(make_shard, *shard))
                    time.sleep(POLL)
                    made = read_manifests(folder, game, dqn_seed, transitions, longest, made)
                    progress(min(count_transitions(made), transitions))
    progress(transitions)
    files.write_text(logs.parent / "manifest.json", json.dumps(made, indent=1) + "\n")
    return made


def is_whole(folder: Path, game: Game, transitions: int, dqn_seed: int, longest: int) -> bool:
    """Returns whether `collect` has already made all transitions.

    Raises:
        UserError: `collect` would make other files.
    """
    return (
        count_transitions(read_manifests(folder, game, dqn_seed, transitions, longest))
        >= transitions
    )


def find_shards(folder: Path, game: Game, transitions: int, dqn_seed: int) -> range | None:
    """Returns the numbers of the first files that together hold so many `transitions`.

    Returns `None` if the files were not made here, or hold too few transitions.

    Raises:
        UserError: the files are of another game or `dqn_seed`.
    """
    made = read_manifests(folder, game, dqn_seed, transitions)
    return range(len(made)) if count_transitions(made) >= transitions else None


def _claim(logs: Path) -> None:
    """Marks a folder, which allows `collect` to replace its files.

    Raises:
        UserError: the folder holds files that were not made here.
    """
    theirs = [path.name for path in logs.glob("*_ckpt.*.gz")]
    if theirs and not (logs / MARK).exists() and not any(logs.glob("manifest.*.json")):
        raise UserError(
            f"{logs} holds files that were not made here, such as {min(theirs)}: name "
            "this folder of demonstrations to learn from them, or make others in another one"
        )
    files.write_text(logs / MARK, "")


def make_shard(folder: Path, name: str, dqn_seed: int, number: int, longest: int) -> Manifest:
    """Plays the games of one file and writes it; returns its manifest."""
    game = find_game(name)
    logs = replay.replay_logs(folder, game, dqn_seed)
    first = TRAINING_START + dqn_seed * TRAINING_STRIDE + number * GAMES
    played: list[replay.Episode] = []
    games: list[dict[str, Any]] = []
    while sum(len(episode.actions) for episode in played) < SHARD:
        index = len(played)
        seed, noise = first + index, playing.choose_noise(game, number + index)
        each = playing.play(game, seed, noise, longest)
        played.append(replay.Episode(each.frames, each.actions, each.rewards))
        games.append(
            {
                "seed": seed, "noise": noise, "score": each.score,
                "transitions": len(each.actions),
            }
        )  # fmt: skip
    replay.write_shard(logs, number, played)
    manifest = {
        "game": name, "run": dqn_seed, "shard": number, "longest": longest,
        **playing.describe_rules(game), "games": games,
        "versions": {each: metadata.version(each) for each in ("leapjax", "ale-py", "numpy")},
    }  # fmt: skip
    # The manifest is written last: a file without a manifest is made again.
    files.write_text(manifest_path(logs, number), json.dumps(manifest) + "\n")
    return manifest
