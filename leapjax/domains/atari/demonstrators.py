"""Players that are built in, so that data can be made without a download.

They know what the emulator's memory means. Paddles and the submarine follow rules; Qbert searches
a tree of hops in the emulator.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from leapjax.checks import check_seed
from leapjax.domains.atari.emulator import MOST_NOOPS, SCREEN, Emulator
from leapjax.domains.atari.games import GAMES, MAX_STEPS, Game

Demonstrator = Callable[[Emulator, np.random.Generator], int]
# what to do now; leaves the emulator as it found it. One plays one game, from its start on.

# Probabilities of a random action, so that returns vary. None plays without: what is lost must be
# found again, and who goes in circles must get out. A paddle that is always where it should be
# teaches nothing about how to come back: cloned, it misses a ball and stays (docs/tried.md).
_NOISES = (0.1, 0.3, 0.5)
# Who learns from more noise in Seaquest scores as much, though its demonstrator scores less.
_MORE_NOISE = {"Seaquest": (0.3, 0.5, 0.7)}

# By game; raised whenever what its demonstrator does changes: nobody then goes on with games that
# the one before has begun to play.
_RULES = dict.fromkeys(GAMES, 1)

_NOOP = 0  # in every game


def noise_of(game: Game, number: int) -> float:
    """How probable a random action is in one of the games that are played for data."""
    noises = _MORE_NOISE.get(game.name, _NOISES)
    return noises[number % len(noises)]


def rules_of(game: Game) -> dict[str, Any]:
    """Who plays a game, and by which version of its rules, as a manifest says it."""
    player = make_demonstrator(game)
    name = getattr(player, "__name__", type(player).__name__)
    return {"demonstrator": name.strip("_"), "rules": _RULES[game.name]}


class PlayedGame(NamedTuple):
    """What was seen, done and won in a game of `n` decisions."""

    frames: np.ndarray  # [n, 84, 84] uint8: before each action
    actions: np.ndarray  # [n] int32: as executed
    rewards: np.ndarray  # [n] float32, not clipped

    @property
    def score(self) -> float:
        """The sum of all rewards."""
        return float(self.rewards.sum())


def play(game: Game, seed: int, noise: float, most_steps: int = MAX_STEPS) -> PlayedGame:
    """Plays a game; the same one for the same arguments.

    Args:
        game: which.
        seed: of the no-ops that it starts with, up to 30, and of all that is random.
        noise: how probable it is that a random action takes the place of a decision.
        most_steps: after how many decisions to stop; some games hardly end.
    """
    starts, noises, thoughts = (
        np.random.default_rng(part) for part in np.random.SeedSequence(check_seed(seed)).spawn(3)
    )
    emulator, demonstrator = Emulator(game), make_demonstrator(game)
    emulator.reset(int(starts.integers(MOST_NOOPS + 1)))
    frames: list[np.ndarray] = []
    actions: list[int] = []
    rewards: list[float] = []
    while not emulator.over and len(actions) < most_steps:
        frames.append(emulator.frame())
        action = demonstrator(emulator, thoughts)
        if noises.random() < noise:
            action = int(noises.integers(emulator.num_actions))
        actions.append(action)
        rewards.append(emulator.step(action))
    return PlayedGame(np.stack(frames), np.array(actions, np.int32), np.array(rewards, np.float32))


def make_demonstrator(game: Game) -> Demonstrator:
    """A player for one game."""
    makers: dict[str, Callable[[], Demonstrator]] = {
        "Breakout": lambda: _Paddle(_BREAKOUT),
        "Qbert": _Qbert,
        "Pong": lambda: _Paddle(_PONG),
        "Seaquest": lambda: _seaquest,
    }
    return makers[game.name]()


class _Table(NamedTuple):
    """A game with a ball, which flies along, to and from a paddle, which moves across."""

    along: int  # where in memory the ball is; 0 there means that there is none
    across: int
    paddle: int
    line: int  # where along the paddle is
    walls: tuple[int, int]  # where across the ball bounces
    middle: float  # of the paddle: where across the ball is then, less the paddle's number
    more: int  # the action that makes the paddle's number greater
    less: int
    tap: float  # how far one decision moves the paddle
    coast: float  # how much of it comes after the decision
    stay: int  # moves nowhere; in Breakout it asks for a ball, too: moments without one are rare
    spread: float  # how far from its middle to hit a ball, at most: always hit alike, it may circle


_PONG = _Table(49, 54, 51, 187, (44, 207), 5, 3, 2, 22.5, 12.5, _NOOP, 1)
_BREAKOUT = _Table(101, 99, 72, 180, (55, 201), 9, 2, 3, 22, 11, 1, 3)
_AHEAD = 2.0  # decisions that a ball's way is followed: further on, it wins no more


def _bounce(position: float, low: float, high: float) -> float:
    """Where something is between two walls that would be at `position` without them."""
    span = high - low
    return low + span - abs((position - low) % (2 * span) - span)


def _coming(table: _Table, before: np.ndarray, ram: np.ndarray) -> bool:
    """Whether the ball flies towards the paddle."""
    return 0 < before[table.along] < ram[table.along]


def _steer(table: _Table, before: np.ndarray, ram: np.ndarray, action: int, aim: float) -> int:
    """What to do, given the memory one decision ago and now, `[128]`, and that decision."""
    along, across, paddle = (int(ram[at]) for at in (table.along, table.across, table.paddle))
    if along == 0:
        return table.stay
    goal = float(across)
    if _coming(table, before, ram):
        ahead = min(max(table.line - along, 0) / (along - int(before[table.along])), _AHEAD)
        goal = _bounce(across + ahead * (across - int(before[table.across])), *table.walls)
    # After a move the paddle goes on: what counts is where it will come to rest.
    rest = paddle + table.coast * ((action == table.more) - (action == table.less))
    error = goal - table.middle - aim - rest
    if abs(error) <= table.tap / 2:
        return table.stay
    return table.more if error > 0 else table.less


class _Paddle:
    """Plays Pong and Breakout: goes with the ball.

    By a rule that can be told from the frames. Tries in the emulator, of where best to hit each
    ball, win more, and teach less.
    """

    def __init__(self, table: _Table) -> None:
        self._table = table
        self._before = np.zeros(128, np.uint8)
        self._aim = 0.0  # where to hit the next ball, away from the middle

    def __call__(self, emulator: Emulator, random: np.random.Generator) -> int:
        table, before, ram = self._table, self._before, emulator.ram()
        self._before = ram
        if not _coming(table, before, ram):
            self._aim = random.uniform(-1, 1) * table.spread
        return _steer(table, before, ram, emulator.action, self._aim)


_TILES = (
    21, 52, 54, 83, 85, 87, 98, 100, 102, 104, 1, 3, 5, 7, 9, 32, 34, 36, 38, 40, 42,
)  # fmt: skip  # where in memory their colours are, row by row
_TILE_PLACES = [(row, place) for row in range(6) for place in range(row + 1)]
_HOPS = {5: (1, 0), 3: (1, 1), 2: (-1, 0), 4: (-1, -1)}  # by action: rows and places gone
_LONGEST_HOP = 12  # decisions; most take 7
_WAIT = 4  # decisions
_HOPS_AHEAD = 2  # with 3 it saw no more, and put off what was to be done
_DIED = -40.0  # the value of it, in tiles
_FAR = 0.08  # what a hop is worth on the way to a tile: less than one tile from corner to corner


def _rests(ram: np.ndarray) -> bool:
    """Whether Qbert stands somewhere, and can hop."""
    return bool(ram[82] == 0 and ram[114] == 0 and ram[43] > 0)


def _tile(ram: np.ndarray) -> tuple[int, int]:
    """The row where Qbert stands, and the place in it."""
    row = round((int(ram[67]) - 25) / 28)
    return row, round(((int(ram[43]) - 77) / 12 + row) / 2)


def _is_tile(row: int, place: int) -> bool:
    return 0 <= place <= row < 6


class _Qbert:
    """Searches a tree of hops wherever it can hop.

    Where it cannot, it asks for the hop that comes after, or for some hop. Whoever learns from it
    need not tell the moment to hop: from one that asks at that moment alone, or does nothing
    between two lives, one learns to do nothing for ever.
    """

    def __init__(self) -> None:
        self._colours: list[int] = []  # that tiles have had in this round, in order
        self._next = _NOOP  # the hop after the one that is being done
        self._lives = 0

    def __call__(self, emulator: Emulator, random: np.random.Generator) -> int:
        del random  # whoever learns from it can learn which of two equally good hops it does
        ram = emulator.ram()
        colours = [int(ram[at]) for at in _TILES]
        if len(set(colours)) == 1:  # a new round
            self._colours = []
        self._colours = list(dict.fromkeys(self._colours + colours))
        if emulator.lives < self._lives:
            self._next = _NOOP
        self._lives = emulator.lives
        if not _rests(ram):
            return self._next or self._some_hop(ram)
        _, action, self._next = self._search(emulator, _HOPS_AHEAD)
        return action

    def _some_hop(self, ram: np.ndarray) -> int:
        """A hop that does not leave the pyramid."""
        row, place = _tile(ram)
        for action, (down, aside) in _HOPS.items():
            if _is_tile(row + down, place + aside):
                return action
        return 3  # it is in no place now

    def _search(self, emulator: Emulator, depth: int) -> tuple[float, int, int]:
        """The value of the best that can be done now, in tiles, the action, and the one after."""
        saved, (row, place) = emulator.save(), _tile(emulator.ram())
        most, best, after = -np.inf, _NOOP, _NOOP
        for action in (*_HOPS, _NOOP):  # of those that are equally good the first one is done
            down, aside = _HOPS.get(action, (0, 0))
            if depth < _HOPS_AHEAD and not _is_tile(row + down, place + aside):
                continue  # whether there is a disc beyond the edge is only tried for the first hop
            value, then = self._hop(emulator, action), _NOOP
            if value > _DIED:
                if depth > 1 and _rests(emulator.ram()):
                    more, then, _ = self._search(emulator, depth - 1)
                    value += 0.95 * more
                else:
                    value -= _FAR * self._distance(emulator.ram())
            emulator.restore(saved)
            if value > most + 1e-6:
                most, best, after = value, action, then
        return most, best, after

    def _hop(self, emulator: Emulator, action: int) -> float:
        """Hops until Qbert has landed, or waits; the reward, in tiles."""
        lives, reward = emulator.lives, 0.0
        for step in range(_LONGEST_HOP if action else _WAIT):
            reward += emulator.advance(_NOOP if step else action)
            if emulator.lives < lives:
                return _DIED
            if action and step and _rests(emulator.ram()):
                break
        return reward / 25

    def _distance(self, ram: np.ndarray) -> int:
        """How many hops it is to a tile whose colour has changed least often in this round."""
        row, place = _tile(ram)
        known = {colour: stage for stage, colour in enumerate(self._colours)}
        stages = [known.get(int(ram[at]), len(known)) for at in _TILES]
        return min(
            abs(place - to_place) + abs(row - place - to_row + to_place)
            for stage, (to_row, to_place) in zip(stages, _TILE_PLACES, strict=True)
            if stage == min(stages)
        )


# By where they go, right and down: the actions that fire, too.
_SHOTS = {
    (0, 0): 1, (0, -1): 10, (1, 0): 11, (-1, 0): 12, (0, 1): 13, (1, -1): 14, (-1, -1): 15,
    (1, 1): 16, (-1, 1): 17,
}  # fmt: skip
_LANES = (103, 79, 55, 31)  # how deep the submarine is in each; all others keep to one
_SURFACE = 13
_UP = ((20, _SURFACE), (32, _LANES[3]), (44, _LANES[2]))  # with less air than that: how deep to be
_HOME = 1  # the lane to be in when there is no diver to be seen
_TURNS = (56, 96)  # where to turn round when there is nothing to go for
_REACH = range(21, 135)  # where the submarine can be
_BOAT = 6  # divers
_TANK = 60  # air, nearly all there can be
_CLOSE = 24  # how near not to go to an enemy
_PASSED = 16  # how far behind the submarine an enemy does no harm


class Swimmer(NamedTuple):
    """One of those that cross the screen."""

    across: int
    lane: int
    way: int  # 1: to the right, -1: to the left


class Scene(NamedTuple):
    """What is to be seen of Seaquest."""

    across: int  # where the submarine is
    depth: int
    facing: int  # 1: right, -1: left
    air: int
    aboard: int  # divers
    enemies: list[Swimmer]  # their missiles among them
    divers: list[Swimmer]


def look(ram: np.ndarray) -> Scene:
    """The meaning of Seaquest's memory, `[128]`."""
    enemies: list[Swimmer] = []
    divers: list[Swimmer] = []
    for lane in range(len(_LANES)):
        kind, row, first, other = (int(ram[at + lane]) for at in (89, 36, 30, 71))
        way = -1 if kind & 8 else 1
        for bit, place in ((4, 0), (2, 16), (1, 32)):  # up to three in a row
            across = (first + place) % 256
            if row & bit and across < SCREEN[1]:
                enemies.append(Swimmer(across, lane, way))
        if 0 < other < SCREEN[1]:
            shot = 4 <= kind % 8 <= 6  # a lane of submarines
            (enemies if shot else divers).append(Swimmer(other, lane, way))
    across, depth, air, aboard = (int(ram[at]) for at in (70, 97, 102, 62))
    return Scene(across, depth, -1 if ram[86] & 8 else 1, air, aboard, enemies, divers)


def _seaquest(emulator: Emulator, random: np.random.Generator) -> int:
    """Goes to and fro in a lane, and fires all the time.

    It goes for divers until it has six, comes up with them, and rises as its air runs out. It never
    stays where it is: whoever learns from one that waits does nothing else (docs/tried.md).
    """
    del random
    scene = look(emulator.ram())
    if scene.depth == _SURFACE and scene.air < _TANK:  # it cannot leave before
        return _SHOTS[0, 1]
    goal = _depth(scene)
    down = int(np.sign(goal - scene.depth)) if abs(goal - scene.depth) > 2 else 0
    if down and _blocked(scene, down):
        down = 0
    elif goal == _SURFACE:
        return _SHOTS[0, -1]
    return _SHOTS[_right(scene, goal), down]


def _depth(scene: Scene) -> int:
    """Where to be, down. To come up without a diver is death."""
    if scene.aboard == _BOAT:
        return _SURFACE
    for least, depth in _UP:
        if scene.aboard and scene.air < least:
            return depth

    def away(diver: Swimmer) -> float:
        return abs(_LANES[diver.lane] - scene.depth) + abs(diver.across - scene.across) / 2

    # From the top: of two that are as far away, to the upper one.
    near = [diver for diver in reversed(scene.divers) if diver.across in _REACH]
    return _LANES[min(near, key=away).lane if near else _HOME]


def _blocked(scene: Scene, down: int) -> bool:
    """Whether an enemy is on the way up or down."""
    return any(
        6 < (_LANES[enemy.lane] - scene.depth) * down < 30
        and abs(enemy.across + 4 * enemy.way - scene.across - 4) < _CLOSE
        for enemy in scene.enemies
    )


def _right(scene: Scene, goal: int) -> int:
    """Where to go along the lane: at the next enemy, to a diver of the goal, or to and fro."""
    ahead = [
        enemy.across - scene.across
        for enemy in scene.enemies
        if abs(_LANES[enemy.lane] - scene.depth) < 12
        and (scene.across - enemy.across) * enemy.way > -_PASSED
    ]
    if ahead:
        gap = min(ahead, key=abs)
        side = 1 if gap > 0 else -1
        return 0 if side == scene.facing and abs(gap) < _CLOSE else side
    for diver in scene.divers:
        away = diver.across - scene.across
        if _LANES[diver.lane] == goal and diver.across in _REACH and abs(away) > 2:
            return int(np.sign(away))
    low, high = _TURNS
    return -1 if scene.across > high else 1 if scene.across < low else scene.facing
