"""A domain that is no grid world of ours: Gymnasium's FrozenLake, in a few lines."""

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
    """The cell that the agent is in, as one token."""

    width: int

    @nn.compact
    def __call__(self, context):
        past = jnp.append(context.past, context.observation)
        return nn.Embed(CELLS, self.width)(past)


def shortest_way(transitions) -> list[int]:
    """Actions from the first cell to the goal; `transitions` is FrozenLake's own table."""
    ways, queue = {0: []}, deque([0])
    while queue:
        cell = queue.popleft()
        for action, [(_, after, _, over)] in transitions[cell].items():
            if after not in ways and (after == GOAL or not over):
                ways[after] = [*ways[cell], action]
                queue.append(after)
    return ways[GOAL]


def make_adapter():
    return GymnasiumAdapter(gym.make(LEVEL, is_slippery=False))


def solve(adapter) -> list[int]:
    return shortest_way(adapter.env.unwrapped.P)


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
    """As for any environment; but plans have four actions, all are executed, and K = 1."""
    found = environments.leapjax("frozen_lake", level, method)
    return change(found, context=1, executed=None, planner=common.search(method, 4, 4))


FROZEN_LAKE = DomainType(Settings, make, (LEVEL,))
