"""A BabyAI level as the rollout sees it."""

import numpy as np

from leapjax.domains.babyai import levels, observations, vocabulary
from leapjax.domains.babyai.levels import Level
from leapjax.domains.babyai.observations import Observation
from leapjax.environments import Transition

# MiniGrid's actions; `done` is never needed, so the end action takes its place.
ACTIONS = ("left", "right", "forward", "pickup", "drop", "toggle", "end")
NUM_ACTIONS = len(ACTIONS)
END = ACTIONS.index("end")
TURNS = (ACTIONS.index("left"), ACTIONS.index("right"))
SLIPS = 1  # which of a level seed's streams of random numbers


class BabyAIAdapter:
    """A BabyAI level with the full observation and a goal fixed at reset."""

    num_actions = NUM_ACTIONS

    def __init__(self, level: Level) -> None:
        self.level = level
        self.env = levels.make_environment(level)
        self.side = max(self.env.width, self.env.height)
        # MiniGrid would draw the agent's partial view at every step, which is not used here and
        # costs more than the step itself.
        self.env.gen_obs = lambda: {}  # type: ignore[method-assign]
        self.goal = observations.NO_GOAL
        self.taken = END  # the last action as it was executed
        self._instruction = np.zeros(level.words, np.int32)
        self._random = np.random.default_rng()

    def reset(self, seed: int) -> Observation:
        """Starts the level of a seed."""
        with levels.silenced():
            self.env.reset(seed=seed)
        self.goal = observations.nearest_goal(self.env)
        self._random = np.random.default_rng([seed, SLIPS])
        self._instruction = vocabulary.encode(self.env.mission, self.level.words)
        return self.observe()

    def close(self) -> None:
        """Closes the environment; the state that it is in can still be looked at."""
        self.env.close()

    @property
    def misled(self) -> bool:
        """Whether an episode ended in front of another match than the goal that was observed."""
        goal = self.goal
        return goal != observations.NO_GOAL and observations.front_cell(self.env) != goal

    def observe(self) -> Observation:
        """The current state."""
        return observations.observe(self.env, self.side, self.goal, self._instruction)

    def step(self, action: int) -> Transition:
        """Takes an action of MiniGrid's first six, or another if the level's turns slip."""
        self.taken = action
        if action in TURNS and self._random.random() < self.level.slip:
            self.taken = int(self._random.choice([a for a in range(END) if a != action]))
        _, reward, terminated, truncated, _ = self.env.step(self.taken)
        success = bool(terminated and float(reward) > 0)
        return Transition(
            self.observe(), float(reward), terminated, truncated, success, taken=self.taken
        )
