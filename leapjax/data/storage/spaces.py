"""Minari spaces of observations: a box for an array, a dictionary of spaces for several fields."""

from typing import Any

import gymnasium as gym
import numpy as np
from minari.serialization import deserialize_space

from leapjax.domain import Domain
from leapjax.types import PyTree

SPACES = ("observation_space", "action_space")  # keys of the metadata


def make_observation_space(blank: PyTree) -> gym.Space:
    """Makes the Minari space of observations that have the shapes and types of `blank`."""
    if isinstance(blank, np.ndarray):
        low, high = -np.inf, np.inf
        if blank.dtype == bool:
            low, high = 0, 1
        elif np.issubdtype(blank.dtype, np.integer):
            low, high = np.iinfo(blank.dtype).min, np.iinfo(blank.dtype).max
        return gym.spaces.Box(low, high, blank.shape, blank.dtype.type)
    return gym.spaces.Dict(
        {name: make_observation_space(x) for name, x in name_parts(blank).items()}
    )


def read_spaces(metadata: dict[str, Any], domain: Domain) -> dict[str, gym.Space]:
    """Reads the spaces of an inspected data set, by part: `observation` and `action`.

    Leaves out the space of observations if `make_observation_space` made it: such a space only
    repeats the shapes and types, which are checked anyway.
    """
    found = {name.removesuffix("_space"): deserialize_space(metadata[name]) for name in SPACES}
    if found["observation"] == make_observation_space(domain.blank):
        del found["observation"]
    return found


def name_parts(observations: PyTree) -> dict[str, Any]:
    """Returns the parts of observations by name; the observations must not be a single array."""
    return observations._asdict() if hasattr(observations, "_asdict") else dict(observations)
