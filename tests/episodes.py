"""Episodes of a Gymnasium environment, and a small network that learns from them."""

import numpy as np

from leapjax.models.config import ModelConfig
from leapjax.types import Demonstration

SMALL = ModelConfig("leapjax", layers=1, heads=2, width=32, dropout=0.0)


def record_episode(env, act, seed):
    """An episode of a policy (observation) -> action."""
    observations, actions, rewards, over = [env.reset(seed=seed)[0]], [], [], [False, False]
    while not any(over):
        actions.append(act(observations[-1]))
        after, reward, *over, _ = env.step(actions[-1])
        observations.append(after)
        rewards.append(reward)
    seen, taken, given = np.array(observations), np.int32(actions), np.float32(rewards)
    return Demonstration(seen, taken, given, *over, seed)
