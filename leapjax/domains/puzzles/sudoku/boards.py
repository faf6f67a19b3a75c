"""Sudoku: boards with one solution, drawn from a seed, and the rules as an energy.

A board has `side` cells in a row, a column and a box. It is read row by row: action number t of
an episode is the digit of cell t, and a clue must be repeated.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import check_seed
from leapjax.domains.puzzles.names import read_numbers
from leapjax.environments import Transition
from leapjax.errors import UserError
from leapjax.types import Array, Demonstration, Window, pad_token

LEVELS = ("Sudoku4x6", "Sudoku9x36")
FEWEST_CLUES = {4: 4, 9: 26}  # boards with fewer take long to find


class Size(NamedTuple):
    """A level: the side of its boards, and how many cells of them are known."""

    side: int
    clues: int

    @property
    def cells(self) -> int:
        """How many there are."""
        return self.side**2


class Board(NamedTuple):
    """What the agent sees."""

    digits: Array  # [cells] int32: 1 .. side; 0 where nothing is written
    cell: Array  # [] int32: which one is written next; `cells` where none is left


def find_level(name: str) -> Size:
    """The level of a name such as Sudoku9x36: boards of 9 by 9 cells, 36 of them known.

    Raises:
        UserError: it is none.
    """
    pattern, expected = r"Sudoku(4|9)x([1-9]\d?)", "Sudoku<4 or 9>x<clues>"
    size = Size(*read_numbers(name, pattern, expected, LEVELS))
    fewest, most = FEWEST_CLUES[size.side], size.cells
    if not fewest <= size.clues <= most:
        raise UserError(f"level {name}: clues must be in {fewest} .. {most}, got {size.clues}")
    return size


@functools.cache
def peers(side: int) -> np.ndarray:
    """`[cells, cells]` bool: whether two cells share a row, a column or a box, and are not one."""
    cell = np.arange(side**2)
    row, column = np.divmod(cell, side)
    box = side_of_box(side)
    groups = (row, column, row // box * box + column // box)
    shared = np.logical_or.reduce([group[:, None] == group for group in groups])
    return shared & ~np.eye(side**2, dtype=bool)


def side_of_box(side: int) -> int:
    """Of a board: 2 or 3."""
    return math.isqrt(side)


def solutions(
    digits: np.ndarray, most: int = 2, rng: np.random.Generator | None = None
) -> list[np.ndarray]:
    """Solutions `[cells]` of a board, the first that are found: an exact search.

    It fills the cell with the fewest possible digits first.

    Args:
        digits: `[cells]`, 0 where nothing is written.
        most: how many to look for.
        rng: in whose order digits are tried; None: ascending.
    """
    side = math.isqrt(len(digits))
    neighbours = [np.flatnonzero(row).tolist() for row in peers(side)]
    found: list[np.ndarray] = []

    def write(options: list[int], cell: int, bit: int) -> bool:
        """Writes a digit, and those that follow from it; False if a cell has none left."""
        options[cell] &= bit
        if not options[cell]:
            return False
        known = [cell]
        while known:
            cell = known.pop()
            for other in neighbours[cell]:
                if options[other] & options[cell]:
                    options[other] &= ~options[cell]
                    if not options[other]:
                        return False
                    if not options[other] & (options[other] - 1):
                        known.append(other)
        return True

    def search(options: list[int]) -> None:
        open_cells = [cell for cell, bits in enumerate(options) if bits & (bits - 1)]
        if not open_cells:
            found.append(np.array([bits.bit_length() for bits in options], np.int32))
            return
        cell = min(open_cells, key=lambda c: options[c].bit_count())
        digits = [d for d in range(side) if options[cell] >> d & 1]
        for digit in digits if rng is None else rng.permutation(digits).tolist():
            tried = options.copy()
            if write(tried, cell, 1 << digit):
                search(tried)
            if len(found) >= most:
                return

    options = [(1 << side) - 1] * len(digits)
    for cell in np.flatnonzero(digits).tolist():
        if not write(options, cell, 1 << int(digits[cell]) - 1):
            return []
    search(options)
    return found


# Every way to search is measured on the same boards. By type, as 5.0 is not the seed 5.
@functools.lru_cache(maxsize=10_000, typed=True)
def draw(size: Size, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The clues `[cells]` (0: none) of a seed, and their only solution `[cells]`.

    Neither may be changed. Cells of a random solution are emptied in random order, as long as the
    rest have one solution; where no more can be, another is begun.
    """
    rng = np.random.default_rng(check_seed(seed))
    while True:
        (solution,) = solutions(np.zeros(size.cells, np.int32), 1, rng)
        clues, order = solution.copy(), rng.permutation(size.cells).tolist()
        excess, several = size.cells - size.clues, size.cells
        while excess and order:
            several = min(several, excess, len(order))
            some, rest = order[:several], order[several:]
            fewer = clues.copy()
            fewer[some] = 0
            if len(solutions(fewer)) == 1:
                clues, order, excess = fewer, rest, excess - several
            elif several == 1:
                order = rest  # this cell is needed
            else:
                several //= 2  # one of these is
        if not excess:
            for board in (clues, solution):
                board.setflags(write=False)
            return clues, solution


class SudokuAdapter:
    """A board as the rollout sees it: actions are digits, less one, for one cell after the other.

    A digit that is not the solution's ends the episode; the last one ends it with success.
    """

    def __init__(self, size: Size) -> None:
        self.size = size
        self.num_actions = size.side + 1
        self.solution = np.zeros(size.cells, np.int32)  # of the current board

    def reset(self, seed: int) -> Board:
        """Draws the board of a seed."""
        clues, self.solution = draw(self.size, seed)
        self._board = Board(clues, np.int32(0))
        return self._board

    def step(self, action: int) -> Transition:
        """Writes a digit."""
        cell, right = int(self._board.cell), bool(self.solution[self._board.cell] == action + 1)
        if right:
            digits = self._board.digits.copy()
            digits[cell] = action + 1
            self._board = Board(digits, np.int32(cell + 1))
        success = right and cell + 1 == self.size.cells
        return Transition(self._board, float(success), success or not right, False, success)


class Puzzle(NamedTuple):
    """What augmentation must know of a step: all of the board's cells, and what was given."""

    clues: Array  # [cells] int8, 0: none
    solution: Array  # [cells] int8


def puzzles(demonstration: Demonstration) -> Puzzle:
    """Of every step, `[n, cells]`."""
    digits = demonstration.observations.digits
    repeated = [np.broadcast_to(board, digits[1:].shape) for board in (digits[0], digits[-1])]
    return Puzzle(*(board.astype(np.int8) for board in repeated))


def transform(key: jax.Array, window: Window, side: int) -> Window:
    """The same window of another board: all that keeps the rules changes.

    Digits change names; bands, and rows in them, change places, and so do stacks and columns; rows
    may become columns. The new board is read row by row too, up to the same cell.
    """
    digit_key, row_key, column_key, turn_key = jax.random.split(key, 4)
    names = jnp.append(0, 1 + jax.random.permutation(digit_key, side))
    rows, columns = _keep_boxes(row_key, side), _keep_boxes(column_key, side)
    places = rows[:, None] * side + columns  # [side, side]
    places = jnp.where(jax.random.bernoulli(turn_key), places, places.T).reshape(-1)
    clues, solution = (
        names[board[places].astype(jnp.int32)].astype(jnp.int32) for board in window.extras
    )
    cells, end = side**2, side
    cell = window.context.observation.cell

    def board(cell: jax.Array) -> Board:
        digits = jnp.where(jnp.arange(cells) < cell, solution, clues)
        return Board(jnp.where(cell < 0, 0, digits), jnp.maximum(cell, 0))

    earlier = cell + jnp.arange(-window.context.actions.shape[0], 0)
    ahead = cell + jnp.arange(window.actions.shape[0])

    def written(at: jax.Array, otherwise: int) -> jax.Array:
        inside = (at >= 0) & (at < cells)
        return jnp.where(inside, solution[jnp.clip(at, 0, cells - 1)] - 1, otherwise)

    context = window.context._replace(
        observation=board(cell),
        past=jax.vmap(board)(earlier),
        actions=written(earlier, pad_token(side + 1)),
    )
    return window._replace(context=context, actions=written(ahead, end))


def _keep_boxes(key: jax.Array, side: int) -> jax.Array:
    """An order `[side]` of rows that keeps together those of a band."""
    box = side_of_box(side)
    band_key, row_key = jax.random.split(key)
    bands = jax.random.permutation(band_key, box)
    within = jax.vmap(lambda k: jax.random.permutation(k, box))(jax.random.split(row_key, box))
    return (bands[:, None] * box + within).reshape(-1)
