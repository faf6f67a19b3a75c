"""A BabyAI level as the rollout sees it."""

import numpy as np

from leapjax.babyai import levels, observations, vocabulary
from leapjax.babyai.levels import Level
from leapjax.babyai.observations import Observation
from leapjax.environments import Transition

# MiniGrid's actions; `done` is never needed, so the end action takes its place.
ACTIONS = ("left", "right", "forward", "pickup", "drop", "toggle", "end")
NUM_ACTIONS = len(ACTIONS)
END = ACTIONS.index("end")


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
