"""Converts trajectories of DQN-Replay to files of memory-mapped frames, and opens the files."""

import itertools
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from leapjax import files
from leapjax.data.storage import UNKNOWN_SEED
from leapjax.domain import Collection
from leapjax.domains.atari.games import HEIGHT, WIDTH, Game
from leapjax.domains.atari.replay.arrays import open_array, read_blocks, read_rows
from leapjax.domains.atari.replay.shards import PADDING, write_header
from leapjax.domains.atari.replay.trajectories import Choice, Span, is_padding
from leapjax.errors import UserError, first_line
from leapjax.types import Demonstration

_FRAMES, _STEPS, _UNFINISHED = "frames.npy", "steps.npz", ".unfinished"


def convert(logs: Path, choice: Choice, game: Game, target: Path) -> None:
    """Unpacks chosen trajectories into a new folder, atomically.

    Raises:
        UserError: the data are damaged or of another game, or the disk is full.
    """
    spans = sorted(choice.spans)  # to read each shard once, from its first row on
    most = sum(span.end - span.start + 1 for span in spans)
    files.check_room(target.parent, most * HEIGHT * WIDTH)
    scratch = target.parent / _UNFINISHED
    shutil.rmtree(scratch, ignore_errors=True)  # a killed program may have left it
    try:
        scratch.mkdir()
        with (scratch / _FRAMES).open("wb") as out:
            write_header(out, np.dtype(np.uint8), (0, HEIGHT, WIDTH))
            steps = [
                step
                for _, of_shard in itertools.groupby(spans, lambda span: span.shard)
                for step in _unpack(logs, list(of_shard), game, out)
            ]
            lengths = [len(actions) for actions, _ in steps]
            out.seek(0)
            write_header(out, np.dtype(np.uint8), (sum(lengths) + len(lengths), HEIGHT, WIDTH))
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
    logs: Path, spans: list[Span], game: Game, out: IO[bytes]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Appends the frames `[n + 1, 84, 84]` of each trajectory of a shard to a file.

    Yields:
        The actions `[n]` and the rewards `[n]` of each trajectory.
    """
    number, first, last = spans[0].shard, spans[0].start, spans[-1].end
    with open_array(logs, number, "action") as array:
        actions = read_rows(array, last)
        low, high = actions[first:].min(), actions[first:].max()
        if low < 0 or high >= len(game.actions):
            raise UserError(
                f"{array.path}: actions run from {low} to {high}, expected 0 to "
                f"{len(game.actions) - 1} of {game.name}: it is of another game or action set"
            )
    with open_array(logs, number, "reward") as array:
        rewards = read_rows(array, last)
        if not np.isfinite(rewards[first:]).all():
            raise UserError(f"{array.path}: rewards that are not finite: copy it again")
    with open_array(logs, number, "observation") as array:
        for _ in read_blocks(array, first):
            pass
        for _, start, end in spans:  # consecutive, without gaps
            head = read_rows(array, min(PADDING, end - start))
            rows = slice(start, min(start + PADDING, end - 1))  # padding ends no episode
            padded = is_padding(actions[rows], rewards[rows], head)
            rest = read_blocks(array, end - start - len(head))
            for block in rest if padded else itertools.chain([head], rest):
                out.write(block.data)
            out.write(block[-1].data)
            start += PADDING if padded else 0
            yield actions[start:end].copy(), rewards[start:end].copy()


def load_conversion(folder: Path) -> Collection:
    """Opens converted trajectories; their frames are views of a memory map.

    Raises:
        UserError: the folder is damaged.
    """
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
