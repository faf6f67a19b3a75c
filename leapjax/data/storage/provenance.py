"""Replays an episode of a data set, to compare the environment with the recorded environment."""

import warnings
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from leapjax.data.storage.datasets import UNKNOWN_SEED, find_version
from leapjax.domain import Described, Domain
from leapjax.environments import Adapter, closing
from leapjax.types import Demonstration, PyTree

COMPARED = 100  # steps to play again, at most


def compare_with_play(
    name: str, recorded: Described, domain: Domain, found: Sequence[Demonstration], exact: bool
) -> None:
    """Plays an episode of a data set again, and warns if the environment behaves differently.

    A data set may not say how its environment was made: Minari leaves that out if a wrapper has a
    function as argument. This plays `COMPARED` steps of the first episode with a known seed.

    Args:
        name: id of the data set.
        recorded: what the data set says of its environment.
        domain: level that the data should come from.
        found: demonstrations of the data set.
        exact: whether observations are stored without loss. If not, this warns of the loss, and
            compares rewards alone.
    """
    made_here = find_version(name) is not None
    if made_here or domain.demonstrations.replay is not None:  # `replay` plays all episodes again
        return
    if not exact:
        warnings.warn(
            f"{name} stores pictures as JPEG, which changes them: a planner that learns from them "
            "plays on others; record with DataCollector(env, jpeg_encoding=False)",
            stacklevel=3,
        )
    known = next((each for each in found if each.seed != UNKNOWN_SEED), None)
    problem = None
    if known is not None:
        with closing(domain.make_adapter()) as adapter:
            problem = _find_difference(adapter, known, exact)
    elif found and recorded.level is None:
        problem = "the data name neither their environment nor the seeds of its resets"
    if problem is not None:
        warnings.warn(
            f"{name} may not have been recorded in {domain.level} as it is played: {problem}; look "
            "for wrappers, other arguments or another version",
            stacklevel=3,
        )


def _find_difference(adapter: Adapter, recorded: Demonstration, exact: bool) -> str | None:
    """Plays an episode again and describes its first difference from the recording, if any.

    Compares observations only if they are `exact`.
    """

    def differs(played: Any, stored: Any) -> bool:
        pairs = zip(jax.tree.leaves(played), jax.tree.leaves(stored), strict=True)
        return not all(np.allclose(one, other, rtol=1e-4, atol=1e-5) for one, other in pairs)

    def state(step: int) -> PyTree:
        return jax.tree.map(lambda leaf: leaf[step], recorded.observations)

    again = f"an episode that is played again with its seed {recorded.seed} has another"
    begun = adapter.reset(recorded.seed)
    if exact and differs(begun, state(0)):
        return f"{again} first observation"
    for step, action in enumerate(recorded.actions[:COMPARED]):
        found = adapter.step(int(action))
        if differs(found.reward, recorded.rewards[step]):
            return f"{again} reward at step {step}"
        if exact and differs(found.observation, state(step + 1)):
            return f"{again} observation after step {step}"
        if found.terminated or found.truncated:
            break
    return None
