"""MiniGrid's own dynamics, started in the state of an `Observation`."""

import numpy as np
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import WorldObj
from minigrid.minigrid_env import MiniGridEnv

from leapjax.domains.babyai import observations
from leapjax.domains.babyai.observations import Observation

FRONT = ((1, 0), (0, 1), (-1, 0), (0, -1))  # step to the cell ahead, by direction


class ObservationEnv(MiniGridEnv):
    """A MiniGrid environment in the state of an `Observation`."""

    def __init__(self, observation: Observation) -> None:
        side = observation.grid.shape[0]
        mission = MissionSpace(mission_func=lambda: "")
        super().__init__(mission, grid_size=side, max_steps=10**6)
        self.grid, _ = Grid.decode(np.asarray(observation.grid))
        self.agent_pos = tuple(int(v) for v in observation.pose[:2])
        self.agent_dir = int(observation.pose[2])
        kind, colour = (int(v) for v in observation.carried)
        self.carrying = WorldObj.decode(kind, colour, 0) if kind else None
        self.step_count = 0
        self.initial = observation

    def gen_obs(self):
        return {}

    def observe(self) -> Observation:
        goal = tuple(int(v) for v in self.initial.goal)
        side = self.initial.grid.shape[0]
        return observations.observe(self, side, goal, np.asarray(self.initial.instruction))


def stepped(observation: Observation, action: int) -> Observation:
    """Returns the state after an action, by MiniGrid's dynamics."""
    env = ObservationEnv(observation)
    env.step(action)
    return env.observe()
