"""Embeds the cells of a grid, and reads features of the grid at a position."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.observations import Observation

# MiniGrid's encoding of a cell: object 0 to 10, colour 0 to 5, state 0 to 3.
OBJECTS, COLOURS, STATES = 11, symmetries.COLOURS, 4
DIRECTIONS = 4
MOST_THINGS = 64  # in a level: BossLevel has some forty
OUTSIDE = 0  # object index of padding, which no cell of a level has


class CellEmbedding(nn.Module):
    """Embeds the content of each cell, from one-hot codes of its object, colour and state.

    Attributes:
        channels: features of a cell.
    """

    channels: int

    @nn.compact
    def __call__(self, observation: Observation) -> jax.Array:
        """Computes `[S, S, channels]`; marks the cells of the agent and the goal."""
        grid = observation.grid
        side = grid.shape[0]
        # One-hot codes and a matrix product: the gradient of a table look-up is a slow scatter.
        kinds = [
            jax.nn.one_hot(grid[..., part], size)
            for part, size in enumerate((OBJECTS, COLOURS, STATES))
        ]
        marks = [
            mark_cell(observation.pose[:2], side)[..., None],
            mark_cell(observation.goal, side)[..., None],
        ]
        features = jnp.concatenate([*kinds, *marks], axis=-1)
        init = nn.initializers.normal(1.0)
        return nn.Dense(self.channels, use_bias=False, kernel_init=init)(features)


def mark_cell(position: jax.Array, side: int) -> jax.Array:
    """Makes `[S, S]` float32: 1 at a position `[2]`; zeros if the position is outside the grid."""
    axis = jnp.arange(side)
    hit = (axis == position[0])[:, None] & (axis == position[1])[None, :]
    return hit.astype(jnp.float32)


def find_things(observation: Observation) -> jax.Array:
    """Returns the flat indices `[n]` of doors, keys, balls, boxes and the agent; S^2 pads the end.

    n is `MOST_THINGS`, or the number of cells if there are fewer.
    """
    kinds = jnp.asarray(observation.grid)[..., 0].reshape(-1)
    cells = kinds.shape[0]
    things = symmetries.is_coloured(kinds) | (kinds == symmetries.AGENT)
    return jnp.nonzero(things, size=min(MOST_THINGS, cells), fill_value=cells)[0]


def read_neighbourhood(image: jax.Array, position: jax.Array, radius: int) -> jax.Array:
    """Reads the `(2 r + 1)^2 * C` features around a position; zeros beyond the border."""
    padded = jnp.pad(image, ((radius, radius), (radius, radius), (0, 0)))
    size = 2 * radius + 1
    start = (
        position[0],
        position[1],
        jnp.zeros_like(position[0]),
    )  # all of the same type, also if JAX uses 64 bits
    return jax.lax.dynamic_slice(padded, start, (size, size, image.shape[-1])).reshape(-1)


def read_cell(image: jax.Array, position: jax.Array) -> jax.Array:
    """Reads the features `[C]` of a cell; zeros if the position is (-1, -1): not observed."""
    return jnp.einsum("xyc,xy->c", image, mark_cell(position, image.shape[0]))
