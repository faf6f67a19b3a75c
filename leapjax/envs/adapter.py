"""Environments as the rollout sees them: the `Adapter` protocol and BabyAI's."""

from typing import NamedTuple, Protocol

import gymnasium as gym
import numpy as np

from leapjax.envs import levels, observations, vocabulary
from leapjax.envs.levels import Level
from leapjax.types import Observation, PyTree

# MiniGrid's actions; `done` is never needed, so the end action takes its place.
ACTIONS = ("left", "right", "forward", "pickup", "drop", "toggle", "end")
NUM_ACTIONS = len(ACTIONS)
END = ACTIONS.index("end")


class Transition(NamedTuple):
    """What one environment step gave."""

    observation: PyTree
    reward: float
    terminated: bool
    truncated: bool
    success: bool  # by the environment's own measure


class Adapter(Protocol):
    """One environment with discrete actions `0 .. A - 2`; the rollout keeps `A - 1`, end.

    An observation is any pytree of NumPy arrays whose shapes never change.
    """

    num_actions: int  # A, the end action included

    def reset(self, seed: int) -> PyTree:
        """Starts the episode of a seed and returns its first observation."""
        ...

    def step(self, action: int) -> Transition:
        """Takes one action."""
        ...


class GymnasiumAdapter:
    """Any Gymnasium environment with discrete actions; success is a positive reward."""

    def __init__(self, env: gym.Env) -> None:
        if not isinstance(env.action_space, gym.spaces.Discrete):
            raise ValueError(f"a Discrete action space is needed, got {env.action_space}")
        self.env = env
        self.num_actions = int(env.action_space.n) + 1
        self._first_action = int(env.action_space.start)

    def reset(self, seed: int) -> PyTree:
        """Starts the episode of a seed."""
        return self.env.reset(seed=seed)[0]

    def step(self, action: int) -> Transition:
        """Takes one action."""
        observation, reward, terminated, truncated, _ = self.env.step(self._first_action + action)
        success = bool(terminated and float(reward) > 0)
        return Transition(observation, float(reward), terminated, truncated, success)


class BabyAIAdapter:
    """A BabyAI level with the full observation and a goal fixed at reset."""

    num_actions = NUM_ACTIONS

    def __init__(self, level: Level) -> None:
        self.level = level
        self.env = levels.make_environment(level)
        self.side = max(self.env.width, self.env.height)
        # MiniGrid would draw the agent's partial view at every step: nobody looks at it,
        # and it costs more than the step itself.
        self.env.gen_obs = lambda: {}  # type: ignore[method-assign]
        self.goal = observations.NO_GOAL
        self._instruction = np.zeros(level.words, np.int32)

    def reset(self, seed: int) -> Observation:
        """Starts the level of a seed."""
        with levels.silenced():
            self.env.reset(seed=seed)
        self.goal = observations.nearest_goal(self.env)
        self._instruction = vocabulary.encode(self.env.mission, self.level.words)
        return self.observe()

    def observe(self) -> Observation:
        """The current state."""
        return observations.observe(self.env, self.side, self.goal, self._instruction)

    def step(self, action: int) -> Transition:
        """Takes one of MiniGrid's first six actions."""
        _, reward, terminated, truncated, _ = self.env.step(action)
        success = bool(terminated and float(reward) > 0)
        return Transition(self.observe(), float(reward), terminated, truncated, success)
