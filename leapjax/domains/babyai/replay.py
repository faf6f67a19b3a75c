"""Plays recorded episodes with MiniGrid's own observations again.

Minari's published data sets of BabyAI hold an image of the agent's view or of the whole grid, a
direction and the mission. They lack the carried object and the goal. The seed of the reset
determines the level, so the recorded actions lead through the same states again, which can then be
observed in full.
"""

import numpy as np

from leapjax.domain import Recording
from leapjax.domains.babyai.adapter import END, BabyAIAdapter
from leapjax.domains.babyai.levels import Level
from leapjax.domains.babyai.observations import Observation
from leapjax.environments import closing
from leapjax.types import Demonstration

NO_SEED = "without the seed of their reset"
DONE = "with the action `done`"
DIFFERENT = "that go otherwise when they are played again"
FAILED = "that failed"
INCOMPLETE = "without an observation for every step"
OTHER_GOAL = "that ended at another match than the nearest"


def replay(recording: Recording, level: Level) -> Demonstration | str | None:
    """Plays a recorded episode again, to make a demonstration of it.

    Args:
        recording: recorded episode.
        level: level of the recording.

    Returns:
        The demonstration, or the reason why the episode cannot be used, or `None` if the
        observations are not MiniGrid's own.
    """
    stored = recording.observations
    if not isinstance(stored, dict) or not {"image", "mission"} <= set(stored):
        return None
    if recording.seed < 0:
        return NO_SEED
    images, missions = np.asarray(stored["image"]), np.asarray(stored["mission"])
    if {len(images), len(missions)} != {len(recording.actions) + 1}:
        return INCOMPLETE
    if (recording.actions >= END).any():
        return DONE
    if not (recording.rewards > 0).any():
        return FAILED
    with closing(BabyAIAdapter(level)) as adapter:
        return _play_again(recording, adapter, images, missions)


def _play_again(
    recording: Recording, adapter: BabyAIAdapter, images: np.ndarray, missions: np.ndarray
) -> Demonstration | str:
    """Plays the recorded actions and compares each state with the recorded one."""
    states = [adapter.reset(recording.seed)]
    same = _matches(adapter, images[0], missions[0])
    success = terminated = truncated = False
    for step, action in enumerate(recording.actions, start=1):
        if terminated or truncated or not same:
            return DIFFERENT
        state, reward, terminated, truncated, success = adapter.step(int(action))[:5]
        states.append(state)
        same = _matches(adapter, images[step], missions[step])
        same = same and bool(np.isclose(reward, recording.rewards[step - 1]))
    if not same or not success:
        return DIFFERENT
    if adapter.misled:
        return OTHER_GOAL
    return Demonstration(
        Observation(*(np.stack(parts) for parts in zip(*states, strict=True))),
        recording.actions.astype(np.int32),
        recording.rewards.astype(np.float32),
        terminated,
        truncated,
        recording.seed,
    )


def _matches(adapter: BabyAIAdapter, image: np.ndarray, mission: np.ndarray) -> bool:
    """Returns whether the current state of a level equals a recorded one."""
    env = adapter.env
    if str(mission) != env.mission:
        return False
    whole = adapter.observe().grid[: env.width, : env.height]
    if np.array_equal(whole, image):
        return True
    # The adapter replaces `gen_obs` of the environment, so call the method of its class.
    return np.array_equal(type(env).gen_obs(env)["image"], image)
