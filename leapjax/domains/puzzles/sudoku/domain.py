"""Sudoku as a `Domain`."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import check_range, check_types
from leapjax.domain import Augmentations, Domain, DomainType
from leapjax.domains.puzzles.common import PuzzleFile, demonstrate
from leapjax.domains.puzzles.sudoku import boards
from leapjax.domains.puzzles.sudoku.boards import Board, SudokuAdapter
from leapjax.domains.puzzles.sudoku.rules import rules
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import embed
from leapjax.types import Context


@dataclasses.dataclass(frozen=True)
class Settings:
    """Sudoku: augmentation, and boards to play.

    Attributes:
        augment: Turn every training window into a window of another board, by symmetries that keep
            the rules.
        boards: Text file of boards that the held-out episodes play in order, in place of drawn
            boards. A line is a board, row by row; 0 or a dot is an open cell. Blank lines and text
            after # are skipped.
    """

    augment: bool = True
    boards: Path | None = None

    def __post_init__(self) -> None:
        check_types(self)


class BoardTokens(Encoder):
    """A token for the cell that is written next, and a token for each cell.

    `encode_positions` gives each action of a plan its cell, so the network need not learn for each
    position which cells share its row, column or box. A plan of the whole board then shows every
    cell and its digit, so `for_plans` leaves the tokens of cells out.

    Attributes:
        side: of the board, in cells.
        width: D, of a token.
        whole: whether plans show every cell.
    """

    side: int
    width: int
    whole: bool = False

    def setup(self) -> None:  # noqa: D102
        self.row = embed(self.side, self.width)
        self.column = embed(self.side, self.width)
        self.box = embed(self.side, self.width)
        self.digit = embed(self.side + 1, self.width)
        self.task = embed(1, self.width)

    def __call__(self, context: Context) -> jax.Array:
        """Tokens `[1, D]` for whole plans, otherwise `[cells + 1, D]`."""
        here = self.task(jnp.zeros(1, jnp.int32)) + self._groups(context.observation.cell[None])
        return here if self.whole else jnp.concatenate([self._cells(context), here])

    def for_plans(self, horizon: int) -> Encoder:  # noqa: D102
        return self.clone(whole=horizon >= self.side**2)

    def encode_positions(self, context: Context, horizon: int) -> jax.Array:
        """Encodes the cells that a plan fills, with their content: `[T, D]`.

        After the last cell come the cells before the first, which are full: plans end before them.
        """
        ahead = context.observation.cell + jnp.arange(horizon)
        return self._cells(context)[ahead % self.side**2]

    def group_positions(self, context: Context, horizon: int) -> jax.Array:
        """Groups cells by row, by column and by box: `[3, T, T]`."""
        ahead = context.observation.cell + jnp.arange(horizon)
        groups = jnp.stack(boards.find_groups(self.side))[:, ahead % self.side**2]
        return groups[:, :, None] == groups[:, None]

    def _cells(self, context: Context) -> jax.Array:
        """Encodes all cells with their digits: `[cells, D]`."""
        return self._groups(jnp.arange(self.side**2)) + self.digit(context.observation.digits)

    def _groups(self, cells: jax.Array) -> jax.Array:
        """Encodes row, column and box of cells `[n]`, clipped to the last cell: `[n, D]`."""
        cells = jnp.minimum(cells, self.side**2 - 1)
        row, column, box = jnp.stack(boards.find_groups(self.side))[:, cells]
        return self.row(row) + self.column(column) + self.box(box)


def make(name: str, settings: Settings) -> Domain:
    """Makes a level by name, such as Sudoku9x36 or Sudoku9x31-42.

    Raises:
        UserError: there is no such level.
    """
    level = boards.find_level(name)
    side = level.side
    make_adapter = functools.partial(SudokuAdapter, side)
    draw_board = functools.partial(boards.draw, level)
    file = None
    if settings.boards is not None:
        read = functools.partial(boards.read_board, side=side)
        file = PuzzleFile(settings.boards, "boards", read)
    transform = functools.partial(boards.transform, side=side)

    def tokens(model: ModelConfig, sizes: Sizes) -> Encoder:
        return BoardTokens(side, model.width)

    return Domain(
        level=name,
        make_adapter=functools.partial(make_adapter, file.find if file else draw_board),
        actions=(*(str(1 + digit) for digit in range(side)), "end"),
        max_steps=level.cells,
        blank=Board(np.zeros(level.cells, np.int32), np.zeros((), np.int32)),
        encoders={"leapjax": tokens},
        demonstrations=demonstrate(
            functools.partial(make_adapter, draw_board),  # training never sees the file
            functools.partial(check_boards, side=side),
        ),
        augmentations=Augmentations([transform] if settings.augment else [], boards.make_puzzles),
        rules=rules(side),
        turn=functools.partial(boards.turn, side=side),
        signature={"side": side},  # any number of clues
        held_out=file.held_out if file else None,
    )


def check_boards(states: Board, where: str, side: int) -> None:
    """Checks that an episode fills a board cell by cell, with its solution.

    Raises:
        UserError: it does not.
    """
    digits, cells = states.digits, side**2
    check_range(f"{where}: digits", digits, 0, side)
    if not np.array_equal(states.cell, np.arange(cells + 1)) or digits[-1].min() < 1:
        raise UserError(f"{where} does not fill the {cells} cells of a board, one after the other")
    groups = [digits[-1][group == n] for group in boards.find_groups(side) for n in range(side)]
    if any(len(set(group)) < side for group in groups):
        raise UserError(f"{where} has a digit twice in a row, a column or a box of its last board")
    if not ((digits == 0) | (digits == digits[-1])).all():
        raise UserError(f"{where} changes a digit that stands on the board")


SUDOKU = DomainType(Settings, make, boards.LEVELS)
