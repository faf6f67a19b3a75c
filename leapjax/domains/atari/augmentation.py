"""Augments windows of a game by reflection."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from leapjax.domains.atari.games import Mirror
from leapjax.types import Window


def mirror_window(key: jax.Array, window: Window, mirror: Mirror, actions: Sequence[str]) -> Window:
    """Reflects a window with probability one half.

    Args:
        key: random key.
        window: window to reflect.
        mirror: reflection of the game.
        actions: names of the game's actions.
    """
    names = [mirror.actions.get(name, name) for name in actions]
    # The end action, MASK and PAD follow the game's own actions, and do not change.
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
    """Reflects frames `[..., 84, 84]`."""
    part = (..., slice(*mirror.rows), slice(*mirror.columns))
    frames = jnp.asarray(frames)
    return frames.at[part].set(jnp.flip(frames[part], mirror.axis - 2))
