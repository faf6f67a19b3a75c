"""Demonstrations of worlds whose solution is known once an episode has begun."""

import itertools
from collections.abc import Callable

import jax
import numpy as np

from leapjax.data import seeds
from leapjax.domain import Collection
from leapjax.environments import Adapter
from leapjax.errors import UserError
from leapjax.types import Array, Demonstration


def collect_solved(
    adapter: Adapter,
    solve: Callable[[], Array],
    count: int,
    seed: int,
    progress: Callable[[int], None],
) -> Collection:
    """`count` demonstrations, of a training seed, of a world whose solution is known.

    Args:
        adapter: the environment.
        solve: after a reset, the actions that solve it.
        count: how many.
        seed: of the training run; see `leapjax.data.seeds`.
        progress: called with the number of demonstrations so far.

    Raises:
        UserError: none are asked for.
    """
    if count < 1:
        raise UserError(f"at least one demonstration is needed, got {count}")
    found = []
    for level_seed in itertools.islice(seeds.training_seeds(seed), count):
        states = [adapter.reset(level_seed)]
        actions = np.array(solve(), np.int32)
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
