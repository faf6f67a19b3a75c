"""Plays games with the built-in demonstrators; defines each game's demonstrator and noise."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from leapjax.checks import check_seed
from leapjax.domains.atari.demonstrators.paddle import BREAKOUT, PONG, Paddle
from leapjax.domains.atari.demonstrators.qbert import Qbert
from leapjax.domains.atari.demonstrators.seaquest import play_seaquest
from leapjax.domains.atari.emulator import MOST_NOOPS, Emulator
from leapjax.domains.atari.games import GAMES, MAX_STEPS, Game

# Chooses an action, and does not change the emulator's state. Plays one game from its start.
Demonstrator = Callable[[Emulator, np.random.Generator], int]

# Probabilities of a random action, so that returns vary and demonstrations show how to recover. A
# paddle that is always in the right place does not teach how to return there: its clone misses a
# ball and then does not move (docs/lessons.md).
NOISES = (0.1, 0.3, 0.5)
# With more noise in Seaquest the demonstrator scores less, but agents that learn from it do not.
MORE_NOISE = {"Seaquest": (0.3, 0.5, 0.7)}
# Version of the demonstrator of each game. Raise it whenever a demonstrator acts differently, so
# that `collect` does not mix its games with earlier games.
RULES = dict.fromkeys(GAMES, 1)

# For each game: the demonstrator's name in manifests, and a function that makes it.
_MAKERS: dict[str, tuple[str, Callable[[], Demonstrator]]] = {
    "Breakout": ("Paddle", lambda: Paddle(BREAKOUT)),
    "Qbert": ("Qbert", Qbert),
    "Pong": ("Paddle", lambda: Paddle(PONG)),
    "Seaquest": ("seaquest", lambda: play_seaquest),
}


def choose_noise(game: Game, number: int) -> float:
    """Chooses the probability of a random action in game `number` of the data."""
    noises = MORE_NOISE.get(game.name, NOISES)
    return noises[number % len(noises)]


def describe_rules(game: Game) -> dict[str, Any]:
    """Returns the entries of a manifest that name the demonstrator and its version."""
    return {"demonstrator": _MAKERS[game.name][0], "rules": RULES[game.name]}


class PlayedGame(NamedTuple):
    """A game of `n` decisions.

    Attributes:
        frames: frames `[n, 84, 84]` uint8 before each action.
        actions: executed actions `[n]` int32.
        rewards: rewards `[n]` float32, not clipped.
    """

    frames: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray

    @property
    def score(self) -> float:
        """The sum of all rewards."""
        return float(self.rewards.sum())


def play(game: Game, seed: int, noise: float, most_steps: int = MAX_STEPS) -> PlayedGame:
    """Plays a game. Equal arguments give equal games.

    Args:
        game: game to play.
        seed: seed of all random choices, such as the number of no-ops at the start, up to 30.
        noise: probability that a random action replaces a decision.
        most_steps: decisions after which to stop, because some games may not end.
    """
    starts, noises, choices = (
        np.random.default_rng(part) for part in np.random.SeedSequence(check_seed(seed)).spawn(3)
    )
    emulator, demonstrator = Emulator(game), make_demonstrator(game)
    emulator.reset(int(starts.integers(MOST_NOOPS + 1)))
    frames: list[np.ndarray] = []
    actions: list[int] = []
    rewards: list[float] = []
    while not emulator.over and len(actions) < most_steps:
        frames.append(emulator.frame())
        action = demonstrator(emulator, choices)
        if noises.random() < noise:
            action = int(noises.integers(emulator.num_actions))
        actions.append(action)
        rewards.append(emulator.step(action))
    return PlayedGame(np.stack(frames), np.array(actions, np.int32), np.array(rewards, np.float32))


def make_demonstrator(game: Game) -> Demonstrator:
    """Makes a demonstrator for one episode of a game."""
    return _MAKERS[game.name][1]()
