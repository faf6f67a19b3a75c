"""A game of the Arcade Learning Environment whose memory can be read, saved and restored.

ale-py's vector environments give no access to memory or state. The frames here equal theirs.
"""

from typing import NamedTuple

import ale_py
import numpy as np
from ale_py import roms

from leapjax.domains.atari.games import FRAME_SKIP, HEIGHT, MAX_FRAMES, WIDTH, Game

NOOP = 0  # index of the no-op in every game
MOST_NOOPS = 30  # most no-ops at the start of a game
SCREEN = (210, 160)  # rows and columns


class Saved(NamedTuple):
    """A saved state of a game.

    Attributes:
        machine: state of the emulator.
        screen: last screen `[210, 160]` uint8.
        action: last action.
    """

    machine: ale_py.ALEState
    screen: np.ndarray
    action: int


def _taps() -> tuple[np.ndarray, np.ndarray]:
    """Computes which three columns of a screen each column of a frame covers.

    Returns:
        Indices and weights of the screen's columns, both `[3, 84]`. A weight is the covered share
        of the frame's column; the three weights sum to 1.
    """
    edges = np.arange(WIDTH + 1) * (SCREEN[1] / WIDTH)
    columns = np.arange(WIDTH) * SCREEN[1] // WIDTH + np.arange(3)[:, None]
    covered = np.minimum(edges[1:], columns + 1) - np.maximum(edges[:-1], columns)
    weights = np.maximum(covered, 0) * (WIDTH / SCREEN[1])
    return np.minimum(columns, SCREEN[1] - 1), weights.astype(np.float32)


_COLUMNS, _WEIGHTS = _taps()


def shrink(screen: np.ndarray) -> np.ndarray:
    """Shrinks a grey screen `[210, 160]` to a frame `[84, 84]` uint8; averages over areas.

    The sums have OpenCV's order, which decides how a half is rounded. A matrix product of this size
    would spend most of its time on waking threads.
    """
    wide = screen.astype(np.float32)
    first, second, third = (wide[:, columns] for columns in _COLUMNS)
    narrow = first * _WEIGHTS[0] + second * _WEIGHTS[1] + third * _WEIGHTS[2]
    rows = narrow.reshape(HEIGHT // 2, 5, WIDTH)  # five rows become two
    whole, half = rows * np.float32(0.4), rows[:, 2] * np.float32(0.2)
    frame = np.empty((HEIGHT // 2, 2, WIDTH), np.float32)
    frame[:, 0] = whole[:, 0] + whole[:, 1] + half
    frame[:, 1] = half + whole[:, 3] + whole[:, 4]
    return np.rint(frame).astype(np.uint8).reshape(HEIGHT, WIDTH)


class Emulator:
    """One game. Only the number of no-ops at its start may be random.

    Attributes:
        game: game that is played.
        action: last action; 0 before the first step.
    """

    action: int

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
        """Number of the game's actions, without the end action."""
        return len(self._actions)

    @property
    def over(self) -> bool:
        """Whether the game has ended."""
        return self._ale.game_over()

    @property
    def lives(self) -> int:
        """Number of lives left."""
        return self._ale.lives()

    def reset(self, noops: int) -> None:
        """Starts a game with `noops` frames of no-ops."""
        self._ale.reset_game()
        for _ in range(noops):
            self._ale.act(self._actions[0])
        self.action = 0
        self._screen = self._ale.getScreenGrayscale()

    def step(self, action: int) -> float:
        """Acts for four frames, and reads the last two screens; returns the unclipped reward."""
        ale, button = self._ale, self._actions[action]
        reward = sum([ale.act(button) for _ in range(FRAME_SKIP - 1)])
        before = ale.getScreenGrayscale()
        reward += ale.act(button)
        # Games draw some objects only in every other frame: the maximum of both shows all objects.
        self._screen = np.maximum(before, ale.getScreenGrayscale())
        self.action = action
        return float(reward)

    def advance(self, action: int) -> float:
        """Acts like `step`, but does not read the screen: `frame` is wrong until `restore`."""
        act, button = self._ale.act, self._actions[action]
        self.action = action
        return act(button) + act(button) + act(button) + act(button)

    def frame(self) -> np.ndarray:
        """Returns the frame `[84, 84]` uint8 after the last `step`."""
        return shrink(self._screen)

    def ram(self) -> np.ndarray:
        """Returns the machine's memory, `[128]` uint8."""
        return self._ale.getRAM()

    def save(self) -> Saved:
        """Returns the current state of the game, for `restore`."""
        return Saved(self._ale.cloneState(), self._screen, self.action)

    def restore(self, saved: Saved) -> None:
        """Goes back to a saved state of this game."""
        self._ale.restoreState(saved.machine)
        self._screen, self.action = saved.screen, saved.action
