"""The demonstrator of Pong and Breakout: a rule that follows the ball."""

from typing import NamedTuple

import numpy as np

from leapjax.domains.atari.emulator import NOOP, Emulator


class Table(NamedTuple):
    """A game with a ball that flies along an axis, and a paddle that moves across it.

    Attributes:
        along: memory address of the ball's position along the axis; the value 0 means no ball.
        across: memory address of the ball's position across the axis.
        paddle: memory address of the paddle's position across the axis.
        line: position of the paddle along the axis.
        walls: positions across the axis where the ball bounces.
        middle: the ball's position minus the paddle's when it hits the middle of the paddle.
        more: action that increases the paddle's position.
        less: action that decreases the paddle's position.
        tap: distance that one decision moves the paddle.
        coast: part of this distance that comes after the decision.
        stay: action that does not move the paddle. In Breakout it also asks for a new ball.
        spread: largest distance from the middle at which to hit a ball. If the paddle always hits
            the ball in the same place, the ball may repeat its path for ever.
    """

    along: int
    across: int
    paddle: int
    line: int
    walls: tuple[int, int]
    middle: float
    more: int
    less: int
    tap: float
    coast: float
    stay: int
    spread: float


PONG = Table(49, 54, 51, 187, (44, 207), 5, 3, 2, 22.5, 12.5, NOOP, 1)
BREAKOUT = Table(101, 99, 72, 180, (55, 201), 9, 2, 3, 22, 11, 1, 3)
_LOOK_AHEAD = 2.0  # decisions for which to predict the ball; more decisions win no more points


class Paddle:
    """Plays Pong and Breakout: follows the ball.

    An agent can infer this rule from the frames. A search in the emulator for the best place to hit
    each ball wins more, but agents learn less from it.
    """

    def __init__(self, table: Table) -> None:
        self._table = table
        self._before = np.zeros(128, np.uint8)
        self._aim = 0.0  # distance from the middle at which to hit the next ball

    def __call__(self, emulator: Emulator, random: np.random.Generator) -> int:
        """Chooses an action."""
        table, before, ram = self._table, self._before, emulator.ram()
        self._before = ram
        if not _approaches(table, before, ram):
            self._aim = random.uniform(-1, 1) * table.spread
        return _steer(table, before, ram, emulator.action, self._aim)


def _approaches(table: Table, before: np.ndarray, ram: np.ndarray) -> bool:
    """Returns whether the ball flies towards the paddle."""
    return 0 < before[table.along] < ram[table.along]


def _steer(table: Table, before: np.ndarray, ram: np.ndarray, action: int, aim: float) -> int:
    """Chooses an action, given the memory before and after the last action, `[128]`."""
    along, across, paddle = (int(ram[at]) for at in (table.along, table.across, table.paddle))
    if along == 0:
        return table.stay
    goal = float(across)
    if _approaches(table, before, ram):
        ahead = min(max(table.line - along, 0) / (along - int(before[table.along])), _LOOK_AHEAD)
        goal = _reflect(across + ahead * (across - int(before[table.across])), *table.walls)
    # The paddle coasts after a move: predict where it will come to rest.
    rest = paddle + table.coast * ((action == table.more) - (action == table.less))
    error = goal - table.middle - aim - rest
    if abs(error) <= table.tap / 2:
        return table.stay
    return table.more if error > 0 else table.less


def _reflect(position: float, low: float, high: float) -> float:
    """Reflects a position at two walls until it lies between them."""
    span = high - low
    return low + span - abs((position - low) % (2 * span) - span)
