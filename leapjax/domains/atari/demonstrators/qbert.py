"""The demonstrator of Qbert: a search in a tree of hops."""

import numpy as np

from leapjax.domains.atari.emulator import NOOP, Emulator

_TILES = (
    21, 52, 54, 83, 85, 87, 98, 100, 102, 104, 1, 3, 5, 7, 9, 32, 34, 36, 38, 40, 42,
)  # fmt: skip  # memory addresses of the colours of the tiles, row by row
_TILE_PLACES = [(row, place) for row in range(6) for place in range(row + 1)]
_HOPS = {5: (1, 0), 3: (1, 1), 2: (-1, 0), 4: (-1, -1)}  # change of row and place, by action
_LONGEST_HOP = 12  # decisions; most take 7
_WAIT = 4  # decisions
_HOPS_AHEAD = 2  # depth of the search; with 3 it scored no more, and put off hops
_DIED = -40.0  # value of losing a life, in tiles
_FAR = 0.08  # cost in tiles of a hop to the nearest tile to change; below 1 from corner to corner


class Qbert:
    """Plays Qbert: searches a tree of hops whenever Qbert can hop.

    While Qbert cannot hop, the demonstrator already chooses the next hop, or any hop. Agents that
    learn from it therefore need not recognise the moment to hop. Agents that learn from a
    demonstrator that waits for this moment, or between two lives, learn to wait for ever.
    """

    def __init__(self) -> None:
        self._colours: list[int] = []  # tiles' colours in this round, in order of appearance
        self._next = NOOP  # the hop after the current one
        self._lives = 0

    def __call__(self, emulator: Emulator, random: np.random.Generator) -> int:
        """Chooses an action."""
        del random  # agents can then learn which of two equally good hops it chooses
        ram = emulator.ram()
        colours = [int(ram[at]) for at in _TILES]
        if len(set(colours)) == 1:  # a new round
            self._colours = []
        self._colours = list(dict.fromkeys(self._colours + colours))
        if emulator.lives < self._lives:
            self._next = NOOP
        self._lives = emulator.lives
        if not _can_hop(ram):
            return self._next or self._choose_any_hop(ram)
        _, action, self._next = self._search(emulator, _HOPS_AHEAD)
        return action

    def _choose_any_hop(self, ram: np.ndarray) -> int:
        """Chooses a hop that does not leave the pyramid."""
        row, place = _find_tile(ram)
        for action, (down, aside) in _HOPS.items():
            if _is_tile(row + down, place + aside):
                return action
        return 3  # Qbert is not on the pyramid

    def _search(self, emulator: Emulator, depth: int) -> tuple[float, int, int]:
        """Finds the best action; returns its value in tiles, the action, and the next action."""
        saved, (row, place) = emulator.save(), _find_tile(emulator.ram())
        most, best, after = -np.inf, NOOP, NOOP
        for action in (*_HOPS, NOOP):  # the first of equally good actions wins
            down, aside = _HOPS.get(action, (0, 0))
            if depth < _HOPS_AHEAD and not _is_tile(row + down, place + aside):
                continue  # only the first hop may leave the pyramid, onto a disc
            value, then = self._hop(emulator, action), NOOP
            if value > _DIED:
                if depth > 1 and _can_hop(emulator.ram()):
                    more, then, _ = self._search(emulator, depth - 1)
                    value += 0.95 * more
                else:
                    value -= _FAR * self._count_hops(emulator.ram())
            emulator.restore(saved)
            if value > most + 1e-6:
                most, best, after = value, action, then
        return most, best, after

    def _hop(self, emulator: Emulator, action: int) -> float:
        """Hops until Qbert has landed, or waits; returns the reward in tiles."""
        lives, reward = emulator.lives, 0.0
        for step in range(_LONGEST_HOP if action else _WAIT):
            reward += emulator.advance(NOOP if step else action)
            if emulator.lives < lives:
                return _DIED
            if action and step and _can_hop(emulator.ram()):
                break
        return reward / 25

    def _count_hops(self, ram: np.ndarray) -> int:
        """Counts hops to the nearest tile whose colour has changed least often in this round."""
        row, place = _find_tile(ram)
        known = {colour: stage for stage, colour in enumerate(self._colours)}
        stages = [known.get(int(ram[at]), len(known)) for at in _TILES]
        return min(
            abs(place - to_place) + abs(row - place - to_row + to_place)
            for stage, (to_row, to_place) in zip(stages, _TILE_PLACES, strict=True)
            if stage == min(stages)
        )


def _can_hop(ram: np.ndarray) -> bool:
    """Returns whether Qbert stands on a tile and can hop."""
    return bool(ram[82] == 0 and ram[114] == 0 and ram[43] > 0)


def _find_tile(ram: np.ndarray) -> tuple[int, int]:
    """Finds the row in which Qbert stands, and its place in the row."""
    row = round((int(ram[67]) - 25) / 28)
    return row, round(((int(ram[43]) - 77) / 12 + row) / 2)


def _is_tile(row: int, place: int) -> bool:
    return 0 <= place <= row < 6
