"""Collects demonstrations of environments that know the solution of an episode at its start."""

import itertools
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np

from leapjax.data import seeds
from leapjax.domain import Collection
from leapjax.environments import Adapter
from leapjax.errors import UserError
from leapjax.types import Array, Demonstration

A = TypeVar("A", bound=Adapter)


def collect_solved(
    make_adapter: Callable[[], A],
    solve: Callable[[A], Array],
    count: int,
    seed: int,
    progress: Callable[[int], None],
) -> Collection:
    """Collects demonstrations of an environment whose solution is known.

    Args:
        make_adapter: makes the environment.
        solve: returns the actions that solve an environment after its reset.
        count: number of demonstrations.
        seed: training seed; see `leapjax.data.seeds`.
        progress: called with the number of demonstrations so far.

    Raises:
        UserError: `count` is less than 1.
    """
    if count < 1:
        raise UserError(f"at least one demonstration is needed, got {count}")
    adapter, found = make_adapter(), []
    for level_seed in itertools.islice(seeds.training_seeds(seed), count):
        states = [adapter.reset(level_seed)]
        actions = np.array(solve(adapter), np.int32)
        played = [adapter.step(int(action)) for action in actions]
        states += [transition.observation for transition in played]
        found.append(
            Demonstration(
                jax.tree.map(lambda *leaves: np.stack(leaves), *states), actions,
                np.array([transition.reward for transition in played], np.float32),
                played[-1].terminated, played[-1].truncated, level_seed,
            )
        )  # fmt: skip
        progress(len(found))
    return Collection(found, {})
