"""Adapts BabyAI levels to the rollout."""

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
SLIPS = 1  # stream of a level seed's random numbers, for slips


class BabyAIAdapter:
    """A BabyAI level with the full observation and a goal fixed at reset.

    Attributes:
        num_actions: A, number of actions with the end action.
        level: level that is played; of a level with members, the member of the last seed.
        env: MiniGrid's environment.
        side: S, side of the grid.
        goal: cell of the goal; `observations.NO_GOAL` if it is not observed.
        taken: last executed action.
    """

    num_actions = NUM_ACTIONS

    def __init__(self, level: Level) -> None:
        self._members = [levels.find_level(name) for name in level.members] or [level]
        self._words = level.words
        self.side, _ = levels.measure_level(level)
        self._open(self._members[0])
        self.goal = observations.NO_GOAL
        self.taken = END
        self._instruction = np.zeros(level.words, np.int32)
        self._random = np.random.default_rng()

    def _open(self, level: Level) -> None:
        """Makes the environment of a level without members."""
        self.level = level
        self.env = levels.make_environment(level)
        # Skip the agent's partial view: it is not used here, and costs more than a step.
        self.env.gen_obs = lambda: {}  # type: ignore[method-assign]

    def reset(self, seed: int) -> Observation:
        """Starts the level of a seed; returns its first state."""
        member = self._members[seed % len(self._members)]
        if member != self.level:
            self.close()
            self._open(member)
        with levels.silenced():
            self.env.reset(seed=seed)
        self.goal = observations.nearest_goal(self.env)
        self._random = np.random.default_rng([seed, SLIPS])
        self._instruction = vocabulary.encode(self.env.mission, self._words)
        return self.observe()

    def close(self) -> None:
        """Closes the environment; its last state stays readable."""
        self.env.close()

    @property
    def misled(self) -> bool:
        """Whether a solved episode ended at another match of the instruction than the goal."""
        goal = self.goal
        return goal != observations.NO_GOAL and observations.front_cell(self.env) != goal

    def observe(self) -> Observation:
        """Returns the current state."""
        return observations.observe(self.env, self.side, self.goal, self._instruction)

    def step(self, action: int) -> Transition:
        """Takes an action; in levels with slips, a turn may become another action at random."""
        self.taken = action
        if action in TURNS and self._random.random() < self.level.slip:
            self.taken = int(self._random.choice([a for a in range(END) if a != action]))
        _, reward, terminated, truncated, _ = self.env.step(self.taken)
        success = bool(terminated and float(reward) > 0)
        return Transition(
            self.observe(), float(reward), terminated, truncated, success, taken=self.taken
        )
