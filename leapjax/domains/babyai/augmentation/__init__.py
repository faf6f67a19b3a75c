"""Augments windows of demonstrations, with a file for each kind of augmentation.

The module `equivalents` applies symmetries of the world and of its language, `clutter` adds
objects, and `goals` hides the goal. A window's `extras`, `[S, S]` bool, mark the cells that the
rest of its demonstration needs free.
"""

import numpy as np

from leapjax.domain import Augmentation
from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.augmentation.clutter import add_clutter
from leapjax.domains.babyai.augmentation.equivalents import apply_symmetries
from leapjax.domains.babyai.augmentation.goals import hide_goal
from leapjax.domains.babyai.augmentation.words import find_words
from leapjax.domains.babyai.settings import Settings
from leapjax.types import Demonstration


def choose_augmentations(settings: Settings) -> list[Augmentation]:
    """Returns the augmentations that the settings ask for; the last is applied first."""
    found: list[Augmentation] = []
    if settings.hidden_goals:
        found.append(lambda key, w: hide_goal(key, w, settings.hidden_goals))
    if settings.augment:
        found.append(
            lambda key, w: apply_symmetries(key, w, find_words(), settings.exchange_objects)
        )
    if settings.clutter:
        found.append(lambda key, w: add_clutter(key, w, settings.clutter))
    return found


def mark_needed_cells(demonstration: Demonstration) -> np.ndarray:
    """Marks the cells that the rest of a demonstration needs free, from each step on.

    The agent stands on these cells, or puts an object down on them.

    Args:
        demonstration: demonstration of n steps.

    Returns:
        Booleans `[n, S, S]`.
    """
    poses, actions = demonstration.observations.pose, demonstration.actions
    needed = np.zeros((len(poses), *demonstration.observations.grid.shape[1:3]), bool)
    needed[np.arange(len(poses)), poses[:, 0], poses[:, 1]] = True
    drops = np.flatnonzero(actions == symmetries.DROP)
    front = poses[drops, :2] + symmetries.DIRECTION_VECTORS[poses[drops, 2]]
    front = front.clip(0, needed.shape[1] - 1)  # a user's data may face out of the grid
    needed[drops, front[:, 0], front[:, 1]] = True
    return np.logical_or.accumulate(needed[::-1])[::-1][:-1]
