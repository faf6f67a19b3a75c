"""More windows from the same games: in a mirror."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from leapjax.domains.atari.games import Mirror
from leapjax.types import Window


def mirrored(key: jax.Array, window: Window, mirror: Mirror, actions: Sequence[str]) -> Window:
    """A window, or with a probability of one half its reflection.

    Args:
        key: of randomness.
        window: as it was played.
        mirror: the game's.
        actions: the game's, by name.
    """
    names = [mirror.actions.get(name, name) for name in actions]
    # The end of an episode, MASK and PAD come after the game's own actions, and stay.
    become = jnp.array([*map(list(actions).index, names), *range(len(names), len(names) + 3)])
    reflection = window._replace(
        context=window.context._replace(
            observation=reflect(window.context.observation, mirror),
            past=reflect(window.context.past, mirror),
            actions=become[window.context.actions],
        ),
        actions=become[window.actions],
    )
    reflects = jax.random.bernoulli(key)
    return jax.tree.map(lambda new, old: jnp.where(reflects, new, old), reflection, window)


def reflect(frames: jax.Array, mirror: Mirror) -> jax.Array:
    """Frames `[..., 84, 84]` as a mirror shows them."""
    part = (..., slice(*mirror.rows), slice(*mirror.columns))
    frames = jnp.asarray(frames)
    return frames.at[part].set(jnp.flip(frames[part], mirror.axis - 2))
