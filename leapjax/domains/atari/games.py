"""The games of the paper: their actions, and published scores."""

from collections.abc import Mapping
from typing import NamedTuple

from leapjax.errors import UserError, did_you_mean

HEIGHT = WIDTH = 84  # size of a frame in pixels (Mnih et al., 2015)
FRAME_SKIP = 4  # frames for which an action is repeated
MAX_FRAMES = 108_000  # most frames of a game: half an hour
MAX_STEPS = MAX_FRAMES // FRAME_SKIP  # most decisions of a game


class Mirror(NamedTuple):
    """A reflection that keeps the rules of a game.

    Attributes:
        axis: axis of frames to reverse: 0 exchanges top and bottom, 1 left and right.
        rows: first row of the reflected part, and the row after its last; the part has no scores.
        columns: first column of the reflected part, and the column after its last.
        actions: new name of each action that changes.
    """

    axis: int
    rows: tuple[int, int]
    columns: tuple[int, int]
    actions: Mapping[str, str]


class Game(NamedTuple):
    """One game of the Arcade Learning Environment.

    Attributes:
        name: name in the paper and in DQN-Replay.
        rom: name in ale-py.
        actions: the game's own actions, in ale-py's order.
        random: score of random actions (Mnih et al., 2015).
        human: score of a professional tester of games.
        target: target return, a sum of clipped rewards.
        return_scale: divisor of returns before a network sees them.
        mirror: reflection that keeps the rules.
        paper: gamer-normalised scores by method (paper, table 3), in percent.
        paper_without_return: LEAP's score without a target return (paper, table 10).
    """

    name: str
    rom: str
    actions: tuple[str, ...]
    random: float
    human: float
    target: float
    return_scale: float
    mirror: Mirror
    paper: Mapping[str, float]
    paper_without_return: float

    def normalised(self, score: float) -> float:
        """Normalises a score: 0 for random actions, 100 for a gamer."""
        return 100 * (score - self.random) / (self.human - self.random)


_JOYSTICK = (
    "noop", "fire", "up", "right", "left", "down", "upright", "upleft", "downright", "downleft",
    "upfire", "rightfire", "leftfire", "downfire", "uprightfire", "upleftfire", "downrightfire",
    "downleftfire",
)  # fmt: skip
_METHODS = ("leap", "dt", "cql", "qr_dqn", "rem", "bc")


def _exchange(*pairs: tuple[str, str]) -> Mapping[str, str]:
    return dict(pairs) | {second: first for first, second in pairs}


_SIDES = _exchange(
    ("right", "left"), ("upright", "upleft"), ("downright", "downleft"), ("rightfire", "leftfire"),
    ("uprightfire", "upleftfire"), ("downrightfire", "downleftfire"),
)  # fmt: skip
_HOPS = _exchange(("up", "left"), ("right", "down"))  # Qbert hops along diagonals


def _paper(*scores: float) -> Mapping[str, float]:
    return dict(zip(_METHODS, scores, strict=True))


GAMES: dict[str, Game] = {
    game.name: game
    for game in (
        Game(
            "Breakout", "breakout", ("noop", "fire", "right", "left"), 1.7, 30.5, 100.0, 50.0,
            Mirror(1, (12, 84), (0, 84), _SIDES),
            _paper(400.9, 267.5, 211.1, 17.1, 8.9, 138.9), 182.0,
        ),
        Game(
            "Qbert", "qbert", ("noop", "fire", "up", "right", "left", "down"),
            163.9, 13455.0, 200.0, 200.0, Mirror(1, (10, 84), (0, 84), _HOPS),
            _paper(19.5, 15.4, 104.2, 0.0, 0.0, 17.3), 41.0,
        ),
        Game(
            "Pong", "pong", ("noop", "fire", "right", "left", "rightfire", "leftfire"),
            -20.7, 14.6, 20.0, 10.0, Mirror(0, (14, 77), (0, 84), _SIDES),
            _paper(108.9, 106.1, 111.9, 18.0, 0.5, 85.2), 100.7,
        ),
        Game(
            "Seaquest", "seaquest", _JOYSTICK, 68.4, 42054.7, 150.0, 100.0,
            Mirror(1, (8, 67), (4, 84), _SIDES),
            _paper(1.3, 2.5, 1.7, 0.4, 0.7, 2.1), 0.5,
        ),
    )
}  # fmt: skip


def find_game(name: str) -> Game:
    """Finds a game by name.

    Raises:
        UserError: the game is unknown; names the known games.
    """
    if name not in GAMES:
        raise UserError(
            f"unknown game {name!r}: expected one of {', '.join(GAMES)}{did_you_mean(name, GAMES)}"
        )
    return GAMES[name]
