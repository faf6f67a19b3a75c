"""Samples whole trajectories from shards: finds their first and last rows."""

import contextlib
import itertools
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from leapjax.checks import check_seed
from leapjax.domains.atari.replay.arrays import open_array, read_rows
from leapjax.domains.atari.replay.shards import PADDING, STORED
from leapjax.errors import UserError

TRAJECTORIES_PER_VISIT = 10  # the Decision Transformer's loader takes 11
CUT_BEFORE, CUT_AFTER = "cut by the beginning of a file", "cut by the end of a file"


class Span(NamedTuple):
    """The rows of a whole trajectory, with its padding if it has any.

    Attributes:
        shard: number of the shard.
        start: first row.
        end: row after the last row.
    """

    shard: int
    start: int
    end: int


class Choice(NamedTuple):
    """A sample of trajectories.

    Attributes:
        spans: trajectories, in the order of the visits.
        dropped: number of cut trajectories in the visited shards, by reason.
    """

    spans: list[Span]
    dropped: Counter[str]


def choose_trajectories(logs: Path, numbers: list[int], transitions: int, seed: int) -> Choice:
    """Samples whole trajectories without unpacking their frames.

    It visits a random shard at a time and takes up to `TRAJECTORIES_PER_VISIT` trajectories, until
    there are enough transitions.

    Raises:
        UserError: there is no whole trajectory.
    """
    rng = np.random.default_rng(check_seed(seed))
    left, waiting = list(numbers), dict[int, list[Span]]()
    chosen, dropped, total = list[Span](), Counter[str](), 0
    while left and total < transitions:
        number = left[rng.integers(len(left))]
        if number not in waiting:
            waiting[number], cut = _find_trajectories(logs, number)
            dropped.update(cut)
        for _ in range(TRAJECTORIES_PER_VISIT):
            if total >= transitions or not waiting[number]:
                break
            span = waiting[number].pop(0)
            total += span.end - span.start - PADDING  # more, if the span has no padding
            chosen.append(span)
        if not waiting[number]:
            left.remove(number)
    if not chosen:
        only = f", only {', '.join(f'{n} {why}' for why, n in dropped.items())}" if dropped else ""
        raise UserError(f"no whole trajectory in {logs}{only}: copy or collect more shards")
    return Choice(chosen, dropped)


def _find_trajectories(logs: Path, number: int) -> tuple[list[Span], Counter[str]]:
    """Finds the whole trajectories of a shard, and counts the cut ones by reason."""
    with contextlib.ExitStack() as stack:
        arrays = {name: stack.enter_context(open_array(logs, number, name)) for name in STORED}
        rows = {name: array.rows for name, array in arrays.items()}
        if len(set(rows.values())) > 1:
            lengths = ", ".join(f"{count} of {name}" for name, count in rows.items())
            raise UserError(
                f"the parts of shard {number} in {logs} are of unequal lengths ({lengths} in "
                f"{arrays['observation'].path.name} and so on): copy them again"
            )
        # The last row does not belong to this shard.
        terminal = read_rows(arrays["terminal"], rows["terminal"])[:-1]
        head = [
            read_rows(arrays[name], min(PADDING, len(terminal)))
            for name in ("action", "reward", "observation")
        ]
    borders = [0, *(np.flatnonzero(terminal) + 1).tolist()]
    spans = [Span(number, *borders) for borders in itertools.pairwise(borders)]
    dropped: Counter[str] = Counter()
    if spans and not is_padding(*head, terminal[:PADDING]):
        spans = spans[1:]
        dropped[CUT_BEFORE] += 1
    if len(terminal) - borders[-1] > PADDING:  # fewer rows are padding of the next episode
        dropped[CUT_AFTER] += 1
    return spans, dropped


def is_padding(*rows: np.ndarray) -> bool:
    """Returns whether the first rows of an episode are padding: three rows of zeros in all arrays.

    A single black frame may belong to the game.
    """
    return all(len(x) == PADDING and not x.any() for x in rows)
