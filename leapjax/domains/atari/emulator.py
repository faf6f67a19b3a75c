"""A game of the Arcade Learning Environment whose memory can be read, saved and restored.

ale-py's vector environments show neither memory nor state. The frames here equal theirs.
"""

from typing import NamedTuple

import ale_py
import numpy as np
from ale_py import roms

from leapjax.domains.atari.games import FRAME_SKIP, HEIGHT, MAX_FRAMES, WIDTH, Game

NOOP = 0  # the action that does nothing, in every game
MOST_NOOPS = 30  # actions that do nothing, with which a game may start
SCREEN = (210, 160)  # rows and columns


class Saved(NamedTuple):
    """A moment of a game, to return to."""

    machine: ale_py.ALEState
    screen: np.ndarray  # [210, 160] uint8
    action: int


def _taps() -> tuple[np.ndarray, np.ndarray]:
    """Which three columns of a screen each column of a frame covers, and how much of each.

    Returns:
        Indices and weights, both `[3, 84]`; weights sum to 1.
    """
    edges = np.arange(WIDTH + 1) * (SCREEN[1] / WIDTH)
    columns = np.arange(WIDTH) * SCREEN[1] // WIDTH + np.arange(3)[:, None]
    covered = np.minimum(edges[1:], columns + 1) - np.maximum(edges[:-1], columns)
    weights = np.maximum(covered, 0) * (WIDTH / SCREEN[1])
    return np.minimum(columns, SCREEN[1] - 1), weights.astype(np.float32)


_COLUMNS, _WEIGHTS = _taps()


def shrink(screen: np.ndarray) -> np.ndarray:
    """A screen `[210, 160]` in grey as a frame `[84, 84]`, uint8: averages over areas.

    The order of the sums is OpenCV's: it decides how a half is rounded. No matrix product, as
    those of a size like this spend most of their time on waking threads.
    """
    wide = screen.astype(np.float32)
    first, second, third = (wide[:, columns] for columns in _COLUMNS)
    narrow = first * _WEIGHTS[0] + second * _WEIGHTS[1] + third * _WEIGHTS[2]
    rows = narrow.reshape(HEIGHT // 2, 5, WIDTH)  # five become two
    whole, half = rows * np.float32(0.4), rows[:, 2] * np.float32(0.2)
    frame = np.empty((HEIGHT // 2, 2, WIDTH), np.float32)
    frame[:, 0] = whole[:, 0] + whole[:, 1] + half
    frame[:, 1] = half + whole[:, 3] + whole[:, 4]
    return np.rint(frame).astype(np.uint8).reshape(HEIGHT, WIDTH)


class Emulator:
    """One game, with no randomness but the number of no-ops that it starts with."""

    action: int  # the last one, 0 at first

    def __init__(self, game: Game) -> None:
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
        self.game = game
        self._ale = ale_py.ALEInterface()
        self._ale.setFloat("repeat_action_probability", 0.0)
        self._ale.setInt("max_num_frames_per_episode", MAX_FRAMES)
        self._ale.setInt("random_seed", 0)
        self._ale.loadROM(str(roms.get_rom_path(game.rom)))
        self._actions = self._ale.getMinimalActionSet()
        self.reset(0)

    @property
    def num_actions(self) -> int:
        """How many actions there are."""
        return len(self._actions)

    @property
    def over(self) -> bool:
        """Whether the game has ended."""
        return self._ale.game_over()

    @property
    def lives(self) -> int:
        """How many are left."""
        return self._ale.lives()

    def reset(self, noops: int) -> None:
        """Starts a game, with some frames in which nothing is done."""
        self._ale.reset_game()
        for _ in range(noops):
            self._ale.act(self._actions[0])
        self.action = 0
        self._screen = self._ale.getScreenGrayscale()

    def step(self, action: int) -> float:
        """Acts for four frames and looks at the last two; the reward, not clipped."""
        ale, button = self._ale, self._actions[action]
        reward = sum([ale.act(button) for _ in range(FRAME_SKIP - 1)])
        before = ale.getScreenGrayscale()
        reward += ale.act(button)
        # Some things are drawn in every other frame only: both together show them all.
        self._screen = np.maximum(before, ale.getScreenGrayscale())
        self.action = action
        return float(reward)

    def advance(self, action: int) -> float:
        """Acts like `step` but does not look: `frame` is wrong until `restore`."""
        act, button = self._ale.act, self._actions[action]
        self.action = action
        return act(button) + act(button) + act(button) + act(button)

    def frame(self) -> np.ndarray:
        """What is to be seen after the last `step`, `[84, 84]` uint8."""
        return shrink(self._screen)

    def ram(self) -> np.ndarray:
        """The machine's memory, `[128]` uint8."""
        return self._ale.getRAM()

    def save(self) -> Saved:
        """This moment, to `restore`."""
        return Saved(self._ale.cloneState(), self._screen, self.action)

    def restore(self, saved: Saved) -> None:
        """Goes back to a moment of this game."""
        self._ale.restoreState(saved.machine)
        self._screen, self.action = saved.screen, saved.action
