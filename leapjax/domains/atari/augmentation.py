"""More windows from the same games: in a mirror, and moved by a few pixels."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from leapjax.domains.atari.games import Mirror
from leapjax.types import Window


def mirror_window(key: jax.Array, window: Window, mirror: Mirror, actions: Sequence[str]) -> Window:
    """Reflects a window with probability one half.

    Args:
        key: of randomness.
        window: to reflect.
        mirror: reflection of the game.
        actions: names of the game's actions.
    """
    names = [mirror.actions.get(name, name) for name in actions]
    # The end action, MASK and PAD follow the game's own actions, and stay.
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


def shifted(key: jax.Array, window: Window, most: int) -> Window:
    """A window whose frames are all moved by the same few pixels (Kostrikov et al., DrQ, 2020)."""
    corner = jax.random.randint(key, (2,), 0, 2 * most + 1)

    def move(frames: jax.Array) -> jax.Array:
        around = [(0, 0)] * (frames.ndim - 2) + [(most, most)] * 2
        wide = jnp.pad(frames, around, mode="edge")
        start = [jnp.int32(0)] * (frames.ndim - 2) + [corner[0], corner[1]]
        return jax.lax.dynamic_slice(wide, start, frames.shape)

    context = window.context
    moved = context._replace(observation=move(context.observation), past=move(context.past))
    return window._replace(context=moved)
