"""A domain from outside leapjax, in a few lines: Gymnasium's FrozenLake."""

import dataclasses
import functools
from collections import deque

import flax.linen as nn
import gymnasium as gym
import jax.numpy as jnp
import numpy as np

from leapjax.configuration import AnyConfig, change
from leapjax.data.solved import collect_solved
from leapjax.domain import Demonstrations, Domain, DomainType
from leapjax.environments import GymnasiumAdapter
from leapjax.models.encoder import Encoder
from leapjax.presets import common, environments

LEVEL = "FrozenLake-v1"
CELLS, GOAL = 16, 15


@dataclasses.dataclass(frozen=True)
class Settings:
    """FrozenLake has no options."""


class Cell(Encoder):
    """Embeds the cell of each state as a token."""

    width: int

    @nn.compact
    def __call__(self, context):
        past = jnp.append(context.past, context.observation)
        return nn.Embed(CELLS, self.width)(past)


def find_shortest_path(transitions) -> list[int]:
    """Finds the fewest actions from the first cell to the goal in FrozenLake's `transitions`."""
    paths, queue = {0: []}, deque([0])
    while queue:
        cell = queue.popleft()
        for action, [(_, next_cell, _, ended)] in transitions[cell].items():
            if next_cell not in paths and (next_cell == GOAL or not ended):
                paths[next_cell] = [*paths[cell], action]
                queue.append(next_cell)
    return paths[GOAL]


def make_adapter():
    return GymnasiumAdapter(gym.make(LEVEL, is_slippery=False))


def solve(adapter) -> list[int]:
    return find_shortest_path(adapter.env.unwrapped.P)


def make(level: str, settings: Settings) -> Domain:
    return Domain(
        level=level,
        make_adapter=make_adapter,
        actions=("left", "down", "right", "up", "end"),
        max_steps=100,
        blank=np.zeros((), np.int64),
        encoders=dict.fromkeys(("paper", "leapjax"), lambda model, sizes: Cell(model.width)),
        demonstrations=Demonstrations(functools.partial(collect_solved, make_adapter, solve)),
    )


def preset(level: str, method: str) -> AnyConfig:
    """Returns the preset for any environment, with K = 1 and plans of four executed actions."""
    config = environments.leapjax("frozen_lake", level, method)
    return change(config, context=1, executed=None, planner=common.search(method, 4, 4))


FROZEN_LAKE = DomainType(Settings, make, (LEVEL,))
