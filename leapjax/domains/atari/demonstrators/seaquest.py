"""The demonstrator of Seaquest: rules for the submarine."""

from typing import NamedTuple

import numpy as np

from leapjax.domains.atari.emulator import SCREEN, Emulator

# Actions that move and fire, by direction (right, down).
_SHOTS = {
    (0, 0): 1, (0, -1): 10, (1, 0): 11, (-1, 0): 12, (0, 1): 13, (1, -1): 14, (-1, -1): 15,
    (1, 1): 16, (-1, 1): 17,
}  # fmt: skip
_LANES = (103, 79, 55, 31)  # the submarine's depth in each lane; enemies, divers keep their lane
_SURFACE = 13
_UP = ((20, _SURFACE), (32, _LANES[3]), (44, _LANES[2]))  # with less air than this, rise to depth
_HOME = 1  # lane to stay in if there is no diver
_TURNS = (56, 96)  # positions at which to turn round if there is no target
_REACHABLE = range(21, 135)  # positions that the submarine can reach
_BOAT = 6  # divers that fit in the submarine
_TANK = 60  # air of an almost full tank
_CLOSE = 24  # distance to keep from an enemy
_PASSED = 16  # distance behind the submarine from which an enemy is harmless


class Swimmer(NamedTuple):
    """An enemy or a diver that crosses the screen.

    Attributes:
        across: horizontal position.
        lane: index of the lane, from the lowest lane up.
        direction: 1 to the right, -1 to the left.
    """

    across: int
    lane: int
    direction: int


class Scene(NamedTuple):
    """A moment of Seaquest.

    Attributes:
        across: horizontal position of the submarine.
        depth: depth of the submarine.
        facing: 1 if the submarine faces right, -1 if left.
        air: air left in the tank.
        aboard: number of divers in the submarine.
        enemies: enemies and their missiles.
        divers: divers in the water.
    """

    across: int
    depth: int
    facing: int
    air: int
    aboard: int
    enemies: list[Swimmer]
    divers: list[Swimmer]


def read_scene(ram: np.ndarray) -> Scene:
    """Reads a scene from Seaquest's memory, `[128]`."""
    enemies: list[Swimmer] = []
    divers: list[Swimmer] = []
    for lane in range(len(_LANES)):
        kind, row, first, other = (int(ram[at + lane]) for at in (89, 36, 30, 71))
        direction = -1 if kind & 8 else 1
        for bit, place in ((4, 0), (2, 16), (1, 32)):  # up to three enemies side by side
            across = (first + place) % 256
            if row & bit and across < SCREEN[1]:
                enemies.append(Swimmer(across, lane, direction))
        if 0 < other < SCREEN[1]:
            shot = 4 <= kind % 8 <= 6  # a lane of enemy submarines, which shoot
            (enemies if shot else divers).append(Swimmer(other, lane, direction))
    across, depth, air, aboard = (int(ram[at]) for at in (70, 97, 102, 62))
    return Scene(across, depth, -1 if ram[86] & 8 else 1, air, aboard, enemies, divers)


def play_seaquest(emulator: Emulator, random: np.random.Generator) -> int:
    """Plays Seaquest: moves to and fro in a lane, and fires all the time.

    The submarine collects six divers and surfaces with them, or rises as its air runs out. It
    never waits, because agents that learn to wait never stop waiting.
    """
    del random
    scene = read_scene(emulator.ram())
    if scene.depth == _SURFACE and scene.air < _TANK:  # it cannot dive until the tank is full
        return _SHOTS[0, 1]
    goal = _choose_depth(scene)
    down = int(np.sign(goal - scene.depth)) if abs(goal - scene.depth) > 2 else 0
    if down and _is_blocked(scene, down):
        down = 0
    elif goal == _SURFACE:
        return _SHOTS[0, -1]
    return _SHOTS[_choose_direction(scene, goal), down]


def _choose_depth(scene: Scene) -> int:
    """Chooses a depth. Surfacing without a diver costs a life."""
    if scene.aboard == _BOAT:
        return _SURFACE
    for least, depth in _UP:
        if scene.aboard and scene.air < least:
            return depth

    def distance(diver: Swimmer) -> float:
        return abs(_LANES[diver.lane] - scene.depth) + abs(diver.across - scene.across) / 2

    # Sorted from the top, so that the upper of two equally distant divers wins.
    near = [diver for diver in reversed(scene.divers) if diver.across in _REACHABLE]
    return _LANES[min(near, key=distance).lane if near else _HOME]


def _is_blocked(scene: Scene, down: int) -> bool:
    """Returns whether an enemy blocks the path up or down."""
    return any(
        6 < (_LANES[enemy.lane] - scene.depth) * down < 30
        and abs(enemy.across + 4 * enemy.direction - scene.across - 4) < _CLOSE
        for enemy in scene.enemies
    )


def _choose_direction(scene: Scene, goal: int) -> int:
    """Chooses a direction along the lane: to the next enemy, to a diver, or to and fro."""
    ahead = [
        enemy.across - scene.across
        for enemy in scene.enemies
        if abs(_LANES[enemy.lane] - scene.depth) < 12
        and (scene.across - enemy.across) * enemy.direction > -_PASSED
    ]
    if ahead:
        gap = min(ahead, key=abs)
        side = 1 if gap > 0 else -1
        return 0 if side == scene.facing and abs(gap) < _CLOSE else side
    for diver in scene.divers:
        away = diver.across - scene.across
        if _LANES[diver.lane] == goal and diver.across in _REACHABLE and abs(away) > 2:
            return int(np.sign(away))
    low, high = _TURNS
    return -1 if scene.across > high else 1 if scene.across < low else scene.facing
