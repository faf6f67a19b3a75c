"""False starts: random moves before a window, which are not imitated."""

import jax
import jax.numpy as jnp

from experiments.augmentation.earlier_moves import prepend_moves
from leapjax.types import Window

FALSE_MOVES = 6  # at most


def add_false_start(key: jax.Array, window: Window, share: float) -> Window:
    """Prepends one to six random moves to a window.

    The moves lead from another pose, which is found backwards, to the first pose of the window.
    So the window shows how to go on after a bad start. Plans under a constraint need that, and
    optimal demonstrations never show it. The model imitates the actions after the moves, but not
    the moves.

    Windows do not change if the moves are impossible, or if there are past states.

    Args:
        key: random key.
        window: one training example.
        share: probability of a false start.
    """
    if window.context.actions.shape[0]:
        return window
    take_key, start_key = jax.random.split(key)
    most = min(FALSE_MOVES, window.actions.shape[0] - 1)
    if most == 0:
        return window
    count_key, moves_key = jax.random.split(start_key)
    count = jax.random.randint(count_key, (), 1, most + 1)
    later, _, possible = prepend_moves(moves_key, window, count, most, 1 / 2)
    later = later._replace(imitated=jnp.arange(window.actions.shape[0]) >= count)
    taken = possible & jax.random.bernoulli(take_key, share)
    return jax.tree.map(lambda a, b: jnp.where(taken, a, b), later, window)
