"""Records episodes of Gymnasium environments; `SMALL` configures a network to learn from them."""

import numpy as np

from leapjax.models.config import ModelConfig
from leapjax.types import Demonstration

SMALL = ModelConfig("leapjax", layers=1, heads=2, width=32, dropout=0.0)


def record_episode(env, act, seed):
    """Records an episode of a policy `act`: (observation) -> action."""
    observations, actions, rewards, ended = [env.reset(seed=seed)[0]], [], [], [False, False]
    while not any(ended):
        actions.append(act(observations[-1]))
        observation, reward, *ended, _ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
    seen, taken, given = np.array(observations), np.int32(actions), np.float32(rewards)
    return Demonstration(seen, taken, given, *ended, seed)
