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
    """A level.

    Attributes:
        side: of its boards, in cells.
        clues: number of known cells.
    """

    side: int
    clues: int

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.side**2


class Board(NamedTuple):
    """An observation: a board and the cell to write next.

    Attributes:
        digits: `[cells]` int32, 1 .. side; 0 for an empty cell.
        cell: `[]` int32, the cell to write next; `cells` if the board is full.
    """

    digits: Array
    cell: Array


def find_level(name: str) -> Size:
    """Reads a level's name, such as Sudoku9x36: boards of 9 by 9 cells with 36 clues.

    Raises:
        UserError: the level does not exist.
    """
    pattern, expected = r"Sudoku(4|9)x([1-9]\d?)", "Sudoku<4 or 9>x<clues>"
    size = Size(*read_numbers(name, pattern, expected, LEVELS))
    fewest, most = FEWEST_CLUES[size.side], size.cells
    if not fewest <= size.clues <= most:
        raise UserError(f"level {name}: clues must be in {fewest} .. {most}, got {size.clues}")
    return size


@functools.cache
def find_peers(side: int) -> np.ndarray:
    """Finds the pairs of cells that share a row, a column or a box: `[cells, cells]` bool."""
    cell = np.arange(side**2)
    row, column = np.divmod(cell, side)
    box = side_of_box(side)
    groups = (row, column, row // box * box + column // box)
    shared = np.logical_or.reduce([group[:, None] == group for group in groups])
    return shared & ~np.eye(side**2, dtype=bool)


def side_of_box(side: int) -> int:
    """Returns the side of a board's boxes: 2 or 3."""
    return math.isqrt(side)


def find_solutions(
    digits: np.ndarray, most: int = 2, rng: np.random.Generator | None = None
) -> list[np.ndarray]:
    """Finds solutions `[cells]` of a board by exact search.

    It fills the cell with the fewest possible digits first.

    Args:
        digits: `[cells]`, 0 for an empty cell.
        most: number of solutions to stop at.
        rng: draws the order in which digits are tried; ascending without it.
    """
    side = math.isqrt(len(digits))
    neighbours = [np.flatnonzero(row).tolist() for row in find_peers(side)]
    found: list[np.ndarray] = []

    def write(options: list[int], cell: int, bit: int) -> bool:
        """Writes a digit and its consequences; False if a cell has no digit left."""
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


# All planners are measured on the same boards. `typed`, as 5.0 is not the seed 5.
@functools.lru_cache(maxsize=10_000, typed=True)
def draw(size: Size, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws the clues `[cells]` (0 is empty) of a seed, and their only solution `[cells]`.

    Both arrays are read-only. It empties cells of a random solution in random order while the
    solution stays the only one. If too many clues are left, it begins with another solution.
    """
    rng = np.random.default_rng(check_seed(seed))
    while True:
        (solution,) = find_solutions(np.zeros(size.cells, np.int32), 1, rng)
        clues, order = solution.copy(), rng.permutation(size.cells).tolist()
        excess, several = size.cells - size.clues, size.cells
        while excess and order:
            several = min(several, excess, len(order))
            some, rest = order[:several], order[several:]
            fewer = clues.copy()
            fewer[some] = 0
            if len(find_solutions(fewer)) == 1:
                clues, order, excess = fewer, rest, excess - several
            elif several == 1:
                order = rest  # this cell is needed
            else:
                several //= 2  # at least a cell of these is needed
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
    """The board of a step, for augmentation.

    Attributes:
        clues: `[cells]` int8, 0 for an empty cell.
        solution: `[cells]` int8.
    """

    clues: Array
    solution: Array


def make_puzzles(demonstration: Demonstration) -> Puzzle:
    """Makes the puzzle of every step: arrays `[n, cells]`."""
    digits = demonstration.observations.digits
    repeated = [np.broadcast_to(board, digits[1:].shape) for board in (digits[0], digits[-1])]
    return Puzzle(*(board.astype(np.int8) for board in repeated))


def transform(key: jax.Array, window: Window, side: int) -> Window:
    """Turns a window into a window of another board, by random symmetries of the rules.

    They permute digits, bands, rows in a band, stacks and columns in a stack, and may exchange rows
    and columns. The new board is read row by row too, up to the same cell.
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

    def write_plan(at: jax.Array, otherwise: int) -> jax.Array:
        inside = (at >= 0) & (at < cells)
        return jnp.where(inside, solution[jnp.clip(at, 0, cells - 1)] - 1, otherwise)

    context = window.context._replace(
        observation=board(cell),
        past=jax.vmap(board)(earlier),
        actions=write_plan(earlier, pad_token(side + 1)),
    )
    return window._replace(context=context, actions=write_plan(ahead, end))


def _keep_boxes(key: jax.Array, side: int) -> jax.Array:
    """Draws an order `[side]` of rows that keeps the rows of each band together."""
    box = side_of_box(side)
    band_key, row_key = jax.random.split(key)
    bands = jax.random.permutation(band_key, box)
    within = jax.vmap(lambda k: jax.random.permutation(k, box))(jax.random.split(row_key, box))
    return (bands[:, None] * box + within).reshape(-1)
