"""Adapts ale-py's native environment to the rollout, with one frame a step."""

import numpy as np
from ale_py.vector_env import AtariVectorEnv

from leapjax.checks import check_integer
from leapjax.domains.atari.games import FRAME_SKIP, HEIGHT, WIDTH, Game
from leapjax.environments import Transition


class AtariAdapter:
    """A game as an environment: an episode is a whole game, after up to 30 no-ops.

    A planner sees rewards clipped to [-1, 1], as in the data. The score sums rewards that are not
    clipped. An episode succeeds if its score reaches `Game.human`.

    Attributes:
        num_actions: A, number of the game's actions with the end action.
        frame: current frame `[84, 84]` uint8.
        score: score of the game so far.
    """

    def __init__(self, game: Game, sticky: float, max_steps: int) -> None:
        self.num_actions = len(game.actions) + 1
        self._game = game
        self._env = AtariVectorEnv(
            game.rom, num_envs=1, num_threads=1, stack_num=1, frameskip=FRAME_SKIP,
            img_height=HEIGHT, img_width=WIDTH, repeat_action_probability=sticky,
            max_num_frames_per_episode=max_steps * FRAME_SKIP, reward_clipping=False,
            use_fire_reset=False,
        )  # fmt: skip
        self.frame = np.zeros((HEIGHT, WIDTH), np.uint8)
        self.score = 0.0
        self._begun: int | None = None  # the action that the game is busy with

    def reset(self, seed: int) -> np.ndarray:
        """Starts the game of a seed; returns its first frame `[84, 84]` uint8."""
        check_integer("the seed of a game", seed)  # ALE's seeds are int32
        if self._begun is not None:  # an action of the previous game is still running
            self._env.recv()
            self._begun = None
        observations, _ = self._env.reset(seed=seed)
        self.frame, self.score = np.array(observations[0, -1]), 0.0
        return self.frame

    def close(self) -> None:
        """Ends the game; `frame` and `score` stay readable."""
        self._env.close()
        del self._env  # ale-py ends a game's thread when its last reference is gone

    def begin(self, action: int) -> None:
        """Begins to take an action, in the game's own thread."""
        self._env.send(np.array([action]))
        self._begun = action

    def step(self, action: int) -> Transition:
        """Takes an action for four frames of the game."""
        if self._begun is None:
            self.begin(action)
        if self._begun != action:
            raise ValueError(f"action {self._begun} was begun, not {action}")
        self._begun = None
        observations, rewards, terminated, truncated, _ = self._env.recv()
        self.frame, self.score = np.array(observations[0, -1]), self.score + float(rewards[0])
        over = bool(terminated[0] or truncated[0])
        return Transition(
            self.frame,
            float(np.clip(rewards[0], -1, 1)),
            bool(terminated[0]),
            bool(truncated[0]),
            over and self.score >= self._game.human,
            float(rewards[0]),
        )
