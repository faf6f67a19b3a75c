"""Sudoku: boards with one solution, drawn from a seed, and the rules as an energy.

A board has `side` cells in a row, a column and a box. It is read row by row: action number t of
an episode is the digit of cell t, and a clue must be repeated.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import check_range, check_seed
from leapjax.domains.puzzles.common import PuzzleAdapter, repeat, rewrite, turn_whole
from leapjax.domains.puzzles.names import read_numbers
from leapjax.errors import UserError
from leapjax.types import Array, Context, Demonstration, Turned, Window

LEVELS = ("Sudoku4x6", "Sudoku9x36")
FEWEST_CLUES = {4: 4, 9: 22}  # it takes ten seconds to draw a board with 21

Branch = tuple[int, int]  # a cell, and the bit of a digit to try in it


class Level(NamedTuple):
    """A level. The number of clues of a board is drawn from `fewest .. most`.

    Attributes:
        side: of its boards, in cells.
        fewest: clues, known cells.
        most: clues.
    """

    side: int
    fewest: int
    most: int

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


def find_level(name: str) -> Level:
    """Reads a level's name.

    Sudoku9x36 has boards of 9 by 9 cells with 36 clues. Sudoku9x31-42 has boards with 31 to 42.

    Raises:
        UserError: the level does not exist.
    """
    pattern = r"Sudoku(4|9)x([1-9]\d?)(?:-([1-9]\d?))?"
    expected = "Sudoku<4 or 9>x<clues> or Sudoku<4 or 9>x<fewest>-<most clues>"
    side, *clues = read_numbers(name, pattern, expected, LEVELS)
    level = Level(side, clues[0], clues[-1])
    if level.fewest > level.most:
        raise UserError(
            f"level {name}: the fewest clues come first: Sudoku{side}x{level.most}-{level.fewest}"
        )
    if level.fewest < FEWEST_CLUES[side] or level.most > level.cells:
        raise UserError(
            f"level {name}: clues must be in {FEWEST_CLUES[side]} .. {level.cells}; boards with "
            "fewer clues take too long to draw: give a file of boards instead",
            "boards",
        )
    return level


@functools.cache
def find_peers(side: int) -> np.ndarray:
    """Finds the pairs of cells that share a row, a column or a box: `[cells, cells]` bool."""
    shared = np.logical_or.reduce([group[:, None] == group for group in find_groups(side)])
    return shared & ~np.eye(side**2, dtype=bool)


def find_groups(side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Finds the row, the column and the box of each cell: arrays `[cells]`."""
    row, column = np.divmod(np.arange(side**2), side)
    box = side_of_box(side)
    return row, column, row // box * box + column // box


def side_of_box(side: int) -> int:
    """Returns the side of a board's boxes: 2 or 3."""
    return math.isqrt(side)


def find_solutions(digits: np.ndarray, most: int = 2) -> list[np.ndarray]:
    """Finds solutions `[cells]` of a board by exact search.

    Args:
        digits: `[cells]` integers, 0 for an empty cell.
        most: number of solutions to stop at.

    Raises:
        UserError: the array is no board.
    """
    digits = check_board(digits)
    side = math.isqrt(len(digits))
    options = [(1 << side) - 1] * len(digits)
    for cell in np.flatnonzero(digits).tolist():
        if not _write(options, cell, 1 << int(digits[cell]) - 1, _list_peers(side)):
            return []
    return list(itertools.islice(_search(options, side, _list_fewest_branches), most))


def check_board(digits: Any) -> np.ndarray:
    """Checks that an array is a board; returns it as int32.

    Raises:
        UserError: it has another shape than `[16]` or `[81]`, or holds other numbers than digits.
    """
    board = np.asarray(digits)
    if board.shape not in {(16,), (81,)}:
        raise UserError(f"a board must be an array of 16 or 81 digits, got shape {board.shape}")
    if board.dtype.kind not in "iu":
        raise UserError(f"a board must hold integers, got {board.dtype}")
    check_range("digits of a board", board, 0, math.isqrt(len(board)))
    return board.astype(np.int32)


def draw_solution(side: int, rng: np.random.Generator) -> np.ndarray:
    """Draws a full board `[cells]`."""

    def list_branches(options: list[int], side: int) -> list[Branch]:
        cell = _find_narrowest_cell(options)
        digits = [digit for digit in range(side) if options[cell] >> digit & 1]
        return [(cell, 1 << digit) for digit in rng.permutation(digits).tolist()]

    return next(_search([(1 << side) - 1] * side**2, side, list_branches))


def _search(
    options: list[int], side: int, list_branches: Callable[[list[int], int], Sequence[Branch]]
) -> Iterator[np.ndarray]:
    """Yields the solutions of a board, depth first.

    Args:
        options: bits of the possible digits of each cell.
        side: of the board.
        list_branches: (options, side) -> cells with the bit of a digit to try in each. Every
            solution writes a digit of the list.
    """
    if all(bits & (bits - 1) == 0 for bits in options):
        yield np.array([bits.bit_length() for bits in options], np.int32)
        return
    for cell, bit in list_branches(options, side):
        tried = options.copy()
        if _write(tried, cell, bit, _list_peers(side)):
            yield from _search(tried, side, list_branches)


def _write(options: list[int], cell: int, bit: int, peers: Sequence[Sequence[int]]) -> bool:
    """Writes a digit; then writes the last possible digit of each cell that has a single one.

    Returns False if a cell has no digit left.
    """
    options[cell] &= bit
    if not options[cell]:
        return False
    known = [cell]
    while known:
        cell = known.pop()
        for other in peers[cell]:
            if options[other] & options[cell]:
                options[other] &= ~options[cell]
                if not options[other]:
                    return False
                if not options[other] & (options[other] - 1):
                    known.append(other)
    return True


def _find_narrowest_cell(options: list[int]) -> int:
    """Finds the first open cell with the fewest possible digits."""
    open_cells = [cell for cell, bits in enumerate(options) if bits & (bits - 1)]
    return min(open_cells, key=lambda cell: options[cell].bit_count())


def _list_fewest_branches(options: list[int], side: int) -> Sequence[Branch]:
    """Lists the digits of a cell, or the cells of a digit in a group, whichever are fewest.

    Returns an empty list if a digit has no cell in a group.
    """
    every = (1 << side) - 1
    two_cells: tuple[Sequence[int], int] | None = None
    for group in _list_groups(side):
        once = twice = more = written = 0
        for cell in group:
            bits = options[cell]
            more |= twice & bits
            twice |= once & bits
            once |= bits
            if not bits & (bits - 1):
                written |= bits
        if once != every:
            return []
        single = once & ~twice & ~written
        if single:
            bit = single & -single
            return [(cell, bit) for cell in group if options[cell] & bit]
        if two_cells is None and twice & ~more:
            two_cells = group, twice & ~more
    cell = _find_narrowest_cell(options)
    if two_cells is not None and options[cell].bit_count() > 2:
        cells, digits = two_cells
        bit = digits & -digits
        return [(cell, bit) for cell in cells if options[cell] & bit]
    return [(cell, 1 << digit) for digit in range(side) if options[cell] >> digit & 1]


@functools.cache
def _list_peers(side: int) -> list[list[int]]:
    """Lists for each cell the cells that share its row, column or box."""
    return [np.flatnonzero(row).tolist() for row in find_peers(side)]


@functools.cache
def _list_groups(side: int) -> list[list[int]]:
    """Lists the cells of each row, column and box."""
    return [np.flatnonzero(group == n).tolist() for group in find_groups(side) for n in range(side)]


# All planners are measured on the same boards. `typed`, as 5.0 is not the seed 5.
@functools.lru_cache(maxsize=10_000, typed=True)
def draw(level: Level, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws the clues `[cells]` (0 is empty) of a seed, and their only solution `[cells]`.

    Both arrays are read-only. A board of a range with n clues is the board that the level with
    exactly n clues draws from the seed.
    """
    seed, clues = check_seed(seed), level.fewest
    if level.fewest < level.most:
        counts = np.random.default_rng([seed, 1])  # another stream than the board's
        clues = int(counts.integers(level.fewest, level.most, endpoint=True))
    return _freeze(*_draw_board(level.side, clues, np.random.default_rng(seed)))


def _draw_board(side: int, clues: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draws clues and their only solution.

    It empties cells of a random solution in random order while the solution stays the only one. If
    too many clues are left, it begins with another solution.
    """
    cells = side**2
    while True:
        solution = draw_solution(side, rng)
        board, order = solution.copy(), rng.permutation(cells).tolist()
        excess, several = cells - clues, cells
        while excess and order:
            several = min(several, excess, len(order))
            some, rest = order[:several], order[several:]
            fewer = board.copy()
            fewer[some] = 0
            if len(find_solutions(fewer)) == 1:
                board, order, excess = fewer, rest, excess - several
            elif several == 1:
                order = rest  # this cell is needed
            else:
                several //= 2  # at least a cell of these is needed
        if not excess:
            return board, solution


@functools.lru_cache(maxsize=10_000)
def read_board(text: str, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Reads the clues and the only solution of a board; 0 or a dot stands for an open cell.

    Raises:
        UserError: the text has other characters or another length, or the board has no solution or
            several.
    """
    digits = "".join(map(str, range(1, side + 1)))
    wrong = next((character for character in text if character not in f".0{digits}"), None)
    if wrong is not None:
        raise UserError(f"{wrong!r} is no cell of a board: expected 1 to {side}, or 0 or . if open")
    if len(text) != side**2:
        raise UserError(
            f"{len(text)} characters, expected {side**2}: the cells of a {side} by {side} board, "
            "row by row"
        )
    clues = np.array(list(text.replace(".", "0")), np.int32)
    solutions = find_solutions(clues)
    if len(solutions) != 1:
        count = "no solution" if not solutions else "several solutions"
        raise UserError(f"the board has {count}, expected exactly one")
    return _freeze(clues, solutions[0])


def _freeze(clues: np.ndarray, solution: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Makes two arrays read-only, as a cache shares them."""
    for board in (clues, solution):
        board.setflags(write=False)
    return clues, solution


class SudokuAdapter(PuzzleAdapter[Board]):
    """A board as the rollout sees it: actions are digits, less one, for one cell after the other.

    A digit that is not the solution's ends the episode; the last one ends it with success.

    Args:
        side: of the board.
        draw_board: (level seed) -> clues and solution.
    """

    def __init__(
        self, side: int, draw_board: Callable[[int], tuple[np.ndarray, np.ndarray]]
    ) -> None:
        self.num_actions = side + 1
        self._draw_board = draw_board

    def draw(self, seed: int) -> tuple[Board, np.ndarray]:
        """Draws the board of a seed."""
        clues, solution = self._draw_board(seed)
        return Board(clues, np.int32(0)), solution - 1

    def move(self, board: Board, action: int) -> tuple[Board, bool | None]:
        """Writes a digit if it is right."""
        if action != self.solution[board.cell]:
            return board, False
        digits = board.digits.copy()
        digits[board.cell] = action + 1
        after = Board(digits, np.int32(board.cell + 1))
        return after, True if after.cell == len(digits) else None


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
    digits = demonstration.observations.digits.astype(np.int8)
    return repeat(Puzzle(digits[0], digits[-1]), demonstration)


def transform(key: jax.Array, window: Window, side: int) -> Window:
    """Turns a window into a window of another board, by random symmetries of the rules.

    The new board is read row by row too, up to the same cell.
    """
    places, digits = _draw_symmetry(key, side)
    names = jnp.append(0, 1 + digits)
    clues, solution = (
        names[board[places].astype(jnp.int32)].astype(jnp.int32) for board in window.extras
    )

    def observe(cell: jax.Array) -> Board:
        return Board(jnp.where(jnp.arange(side**2) < cell, solution, clues), cell)

    return rewrite(window, lambda board: board.cell, solution - 1, observe, end=side)


def turn(key: jax.Array, context: Context, side: int, horizon: int) -> Turned:
    """Turns a board by random symmetries of the rules, for plans that write the whole board."""
    board = context.observation

    def draw() -> tuple[Board, jax.Array, jax.Array]:
        places, digits = _draw_symmetry(key, side)
        found = jnp.append(0, 1 + digits)[board.digits[places]].astype(jnp.int32)
        return board._replace(digits=found), places, digits

    return turn_whole(context, side**2, board.cell == 0, horizon, side + 1, draw)


def _draw_symmetry(key: jax.Array, side: int) -> tuple[jax.Array, jax.Array]:
    """Draws a symmetry of the rules.

    Digits, bands, rows in a band, stacks and columns in a stack change places; rows and columns may
    be exchanged.

    Returns:
        The cell `[cells]` that comes to each place, and the new name `[side]` of each digit, less
        one.
    """
    digit_key, row_key, column_key, turn_key = jax.random.split(key, 4)
    rows, columns = _keep_boxes(row_key, side), _keep_boxes(column_key, side)
    places = rows[:, None] * side + columns  # [side, side]
    places = jnp.where(jax.random.bernoulli(turn_key), places, places.T).reshape(-1)
    return places, jax.random.permutation(digit_key, side)


def _keep_boxes(key: jax.Array, side: int) -> jax.Array:
    """Draws an order `[side]` of rows that keeps the rows of each band together."""
    box = side_of_box(side)
    band_key, row_key = jax.random.split(key)
    bands = jax.random.permutation(band_key, box)
    within = jax.vmap(lambda k: jax.random.permutation(k, box))(jax.random.split(row_key, box))
    return (bands[:, None] * box + within).reshape(-1)
