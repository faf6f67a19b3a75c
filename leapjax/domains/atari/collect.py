"""Data in the format of DQN-Replay for whoever cannot download it: real games, played here.

A file holds a game or more. It depends on its number alone, so that data do not depend on how
many processes made them, nor on how often they were stopped.
"""

import contextlib
import itertools
import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import metadata
from pathlib import Path
from typing import Any

from leapjax import files
from leapjax.data.seeds import TRAINING_START, TRAINING_STRIDE
from leapjax.domains.atari import demonstrators, replay
from leapjax.domains.atari.games import Game, find_game
from leapjax.errors import UserError

# Transitions of a file, at least. A killed program loses the unfinished file of each core: at most
# this and one more game.
SHARD = 1_000
GAMES = 1_000  # of a file, at most
BYTES = 200  # of a transition on the disk, more or less
POLL = 0.2  # seconds
MARK = ".made-by-leapjax"  # in a folder whose files may be replaced

Manifest = dict[str, Any]


def collect(
    folder: Path,
    game: Game,
    transitions: int,
    run: int,
    longest: int,
    workers: int | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Manifest]:
    """Plays until there are so many transitions; goes on where it was stopped.

    Args:
        folder: of all games.
        game: to play.
        transitions: at least so many, in whole games.
        run: number of the run, from 1; others have other games.
        longest: decisions of a game, which is then cut off: see `replay.Episode`.
        workers: processes; None for one on each core.
        progress: called with the number of transitions so far.

    Returns:
        What is in each file: its games, with their scores.

    Raises:
        UserError: there are files of somebody else or of another game, or games of another length
            or by another demonstrator, or a process died.
    """
    logs = replay.replay_logs(folder, game, run)
    workers = workers or len(os.sched_getaffinity(0))
    with files.only_process_in(logs):
        _claim(logs)
        files.check_room(logs, transitions * BYTES)
        made = _made(folder, game, run, transitions, longest)
        if _count(made) < transitions:  # else no process needs to be started
            waiting = (
                n for n in itertools.count() if _known(folder, game, run, n, longest) is None
            )
            with _processes(workers) as pool:
                running: list[Future[Manifest]] = []
                while _count(made) < transitions:
                    running = [each for each in running if not _finished(each)]
                    for _ in range(workers - len(running)):
                        shard = folder, game.name, run, next(waiting), longest
                        running.append(pool.submit(make_shard, *shard))
                    time.sleep(POLL)
                    made = _made(folder, game, run, transitions, longest, made)
                    progress(min(_count(made), transitions))
    progress(transitions)
    files.write_text(logs.parent / "manifest.json", json.dumps(made, indent=1) + "\n")
    return made


def is_whole(folder: Path, game: Game, transitions: int, run: int, longest: int) -> bool:
    """Whether `collect` has nothing left to do.

    Raises:
        UserError: what is there is not what it would make.
    """
    return _count(_made(folder, game, run, transitions, longest)) >= transitions


def shards(folder: Path, game: Game, transitions: int, run: int) -> range | None:
    """The files that so many transitions are in, whatever else was made; None: not made here.

    Raises:
        UserError: they are of another game or run.
    """
    made = _made(folder, game, run, transitions)
    return range(len(made)) if _count(made) >= transitions else None


def _claim(logs: Path) -> None:
    """Marks a folder as one to make files in; refuses one that somebody else's are in.

    Raises:
        UserError: they would be replaced.
    """
    theirs = [path.name for path in logs.glob("*_ckpt.*.gz")]
    if theirs and not (logs / MARK).exists() and not any(logs.glob("manifest.*.json")):
        raise UserError(
            f"{logs} holds files that were not made here, such as {min(theirs)}: learn from them "
            "with --demonstrations, or make others in another --folder"
        )
    files.write_text(logs / MARK, "")


def make_shard(folder: Path, name: str, run: int, number: int, longest: int) -> Manifest:
    """Plays and writes one file; what is in it."""
    game = find_game(name)
    logs = replay.replay_logs(folder, game, run)
    first = TRAINING_START + run * TRAINING_STRIDE + number * GAMES
    played: list[replay.Episode] = []
    games: list[dict[str, Any]] = []
    while sum(len(episode.actions) for episode in played) < SHARD:
        index = len(played)
        seed, noise = first + index, demonstrators.noise_of(game, number + index)
        each = demonstrators.play(game, seed, noise, longest)
        played.append(replay.Episode(each.frames, each.actions, each.rewards))
        games.append(
            {
                "seed": seed, "noise": noise, "score": each.score,
                "transitions": len(each.actions),
            }
        )  # fmt: skip
    replay.write_shard(logs, number, played)
    manifest = {
        "game": name, "run": run, "shard": number, "longest": longest,
        **demonstrators.rules_of(game), "games": games,
        "versions": {each: metadata.version(each) for each in ("leapjax", "ale-py", "numpy")},
    }  # fmt: skip
    # Last: a file without its manifest is made again.
    files.write_text(_manifest(logs, number), json.dumps(manifest) + "\n")
    return manifest


def _manifest(logs: Path, number: int) -> Path:
    return logs / f"manifest.{number}.json"


def _known(
    folder: Path, game: Game, run: int, number: int, longest: int | None = None
) -> Manifest | None:
    """What is in a file that was made here; None if it was not.

    With `longest` it is to be gone on with: then it must be as it would be made today.

    Raises:
        UserError: it is damaged, of another game or run, or not as it would be made today.
    """
    logs = replay.replay_logs(folder, game, run)
    path = _manifest(logs, number)
    if not path.exists() or not replay.has_shard(logs, number):
        return None
    try:
        manifest = json.loads(files.read_text(path))
        _count([manifest])
        noises = [each["noise"] for each in manifest["games"]]
        of = manifest["game"], manifest.get("run", run)
    except (ValueError, KeyError, TypeError, RecursionError):
        raise UserError(f"{path} is damaged: remove it, and its games are played again") from None
    if of != (game.name, run):
        raise UserError(
            f"{logs} holds games of {of[0]}, run {of[1]}, not of {game.name}, run {run}: give the "
            "folder its own name again, or name another one"
        )
    if longest is None:
        return manifest
    another = "remove them, or name another folder"
    found = manifest.get("longest", longest)
    if found != longest:
        raise UserError(
            f"{logs} holds games that were cut off after {found} decisions, not after {longest}: "
            f"{another}"
        )
    rules = demonstrators.rules_of(game)
    # Manifests that do not say were written when all demonstrators had their first rules.
    played = {"demonstrator": rules["demonstrator"], "rules": 1} | {
        name: manifest[name] for name in rules if name in manifest
    }
    if played != rules:
        raise UserError(
            f"{logs} holds games of the demonstrator {played['demonstrator']} with rules "
            f"{played['rules']}, and today's is {rules['demonstrator']} with rules "
            f"{rules['rules']}: {another}"
        )
    if noises != [demonstrators.noise_of(game, number + index) for index in range(len(noises))]:
        raise UserError(
            f"{logs} holds games with other shares of random actions than today's demonstrators "
            f"have: {another}"
        )
    return manifest


def _made(
    folder: Path,
    game: Game,
    run: int,
    transitions: int,
    longest: int | None = None,
    before: Sequence[Manifest] = (),
) -> list[Manifest]:
    """What is in the files that were made here, up to so many transitions, or to a gap.

    `before` are those that are known already.
    """
    made = list(before)
    while _count(made) < transitions:
        manifest = _known(folder, game, run, len(made), longest)
        if manifest is None:
            break
        made.append(manifest)
    return made


def _count(manifests: Sequence[Manifest]) -> int:
    """The transitions of some files."""
    return sum(int(game["transitions"]) for each in manifests for game in each["games"])


@contextlib.contextmanager
def _processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """Processes to play in, which end at once when they are no longer needed.

    Raises:
        UserError: one of them died.
    """
    others = set(multiprocessing.active_children())
    # Not forked: this process may run threads.
    pool = ProcessPoolExecutor(
        count, multiprocessing.get_context("spawn"), initializer=_end_with_the_first
    )
    try:
        yield pool
    except BrokenProcessPool:
        raise UserError(
            "a process that played games has ended, perhaps for want of memory: start the same "
            "command again, perhaps with fewer --workers, and it goes on"
        ) from None
    finally:
        # What they have begun is not waited for: a file without its manifest is made again.
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)


def _finished(made: Future[Manifest]) -> bool:
    """Whether a process is done with its file; what went wrong there is raised here."""
    if not made.done():
        return False
    made.result()
    return True


def _end_with_the_first() -> None:
    """Ctrl-C reaches all processes: the first one ends the others, also when it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    first = multiprocessing.parent_process()

    def follow() -> None:
        if first is not None:
            first.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
