"""Encoders of grids, poses and instructions, for one state.

Convolutions are written as one matrix product over shifted copies: on a CPU this is
several times faster than XLA's own convolution, above all in the gradient.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.models.transformer import dense
from leapjax.types import Observation

# MiniGrid's encoding of a cell: object 0 to 10, colour 0 to 5, state 0 to 3.
OBJECTS, COLOURS, STATES = 11, 6, 4
DIRECTIONS = 4


def patches(image: jax.Array, side: int, padding: tuple[int, int]) -> jax.Array:
    """`[X, Y, C]` to `[X', Y', side * side * C]`: the neighbourhood of every cell."""
    image = jnp.pad(image, (padding, padding, (0, 0)))
    width, height = image.shape[0] - side + 1, image.shape[1] - side + 1
    shifted = [image[x : x + width, y : y + height] for x in range(side) for y in range(side)]
    return jnp.concatenate(shifted, axis=-1)


class Convolution(nn.Module):
    """A convolution of stride 1 as a matrix product."""

    features: int
    side: int = 3
    padding: tuple[int, int] = (1, 1)

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """`[X, Y, C]` to `[X', Y', features]`."""
        kernel_init = nn.initializers.he_normal()
        return nn.Dense(self.features, kernel_init=kernel_init)(
            patches(image, self.side, self.padding)
        )


class InstructionEncoder(nn.Module):
    """Word embeddings and a GRU (paper, appendix, network details)."""

    vocabulary: int
    width: int

    @nn.compact
    def __call__(self, instruction: jax.Array) -> jax.Array:
        """Token ids `[L]`, 0 for padding, to the state after the last word `[width]`."""
        words = nn.Embed(self.vocabulary, self.width)(instruction)
        length = jnp.sum(instruction > 0)
        state, _ = nn.RNN(nn.GRUCell(self.width), return_carry=True)(words, seq_lengths=length)
        return state


class StateEncoder(nn.Module):
    """Pose, goal and carried object to one vector (paper, appendix: 256, 256, 128)."""

    side: int  # S
    width: int

    @nn.compact
    def __call__(self, observation: Observation) -> jax.Array:
        """`[width]`. Coordinates are embedded, not scaled, as in the authors' code."""
        # One more row than the side, for the -1 of an unavailable goal.
        coordinates = nn.Embed(self.side + 1, self.width, name="coordinates")
        parts = [
            coordinates(observation.pose[:2]),
            nn.Embed(DIRECTIONS, self.width, name="direction")(observation.pose[2:]),
            coordinates(jnp.where(observation.goal < 0, self.side, observation.goal)),
            # Not in the appendix: levels where objects are moved need it.
            nn.Embed(OBJECTS, self.width, name="carried")(observation.carried[:1]),
            nn.Embed(COLOURS, self.width, name="carried_colour")(observation.carried[1:]),
        ]
        h = jnp.concatenate(parts).reshape(-1)
        h = jnp.tanh(nn.Dense(2 * self.width)(h))
        h = jnp.tanh(nn.Dense(2 * self.width)(h))
        return nn.Dense(self.width)(h)


class FiLMBlock(nn.Module):
    """Two convolutions modulated by a condition (paper: ExpertControllerFiLM)."""

    width: int

    @nn.compact
    def __call__(self, image: jax.Array, condition: jax.Array) -> jax.Array:
        """`[X, Y, C]` and `[D]` to `[X, Y, width]`."""
        h = nn.relu(channel_norm()(Convolution(self.width)(image)))
        h = Convolution(self.width)(h)
        scale, shift = nn.Dense(self.width)(condition), nn.Dense(self.width)(condition)
        return nn.relu(channel_norm()(h * scale + shift))


def channel_norm() -> nn.GroupNorm:
    """Normalisation that needs no batch, where the authors' code has batch norm."""
    return nn.GroupNorm(num_groups=8)


class PaperStateEncoder(nn.Module):
    """The image encoder of the appendix, fused with instruction and pose by FiLM."""

    side: int
    width: int

    @nn.compact
    def __call__(self, observation: Observation, instruction: jax.Array) -> jax.Array:
        """One state and the encoded instruction `[D]` to the state's token `[width]`."""
        image = observation.grid.astype(jnp.float32)
        h = nn.relu(channel_norm()(Convolution(self.width, 2)(image)))
        h = nn.max_pool(h, (2, 2), (2, 2))
        h = nn.relu(channel_norm()(Convolution(self.width, 3)(h)))
        h = nn.max_pool(h, (2, 2), (2, 2))
        if self.side >= 16:  # "may vary a little depending on the environment size"
            h = nn.max_pool(nn.relu(channel_norm()(Convolution(self.width, 3)(h))), (2, 2), (2, 2))
        for _ in range(2):
            h = FiLMBlock(self.width)(h, instruction)
        state = StateEncoder(self.side, self.width)(observation)
        for _ in range(2):
            h = FiLMBlock(self.width)(h, state)
        return nn.relu(nn.Dense(self.width)(h.reshape(-1)))


class GridEncoder(nn.Module):
    """Cell features that know the way: learned distances, then local convolutions.

    Distances are value iteration in the min-plus sense (Tamar et al., Value Iteration
    Networks): what it costs to enter a cell and where a way ends are both learned from
    the demonstrations, per channel, and a round carries a distance one cell further.
    A round has no matrix product, so dozens of them, which mazes need, cost little.
    """

    channels: int
    fields: int  # distance fields
    sweeps: int  # rounds of distances: how far a way can lead
    rounds: int  # rounds of convolutions, which share their weights

    @nn.compact
    def __call__(self, cells: jax.Array, agent: jax.Array) -> jax.Array:
        """Cell features `[S, S, C]`, agent's cell `[2]`, to `[S, S, channels]`."""
        local = nn.relu(Convolution(self.channels, name="local")(cells))
        bias = nn.initializers.constant(1.0)
        cost = nn.softplus(nn.Dense(self.fields, bias_init=bias, name="cost")(local))
        far = nn.initializers.constant(10.0)
        start = nn.softplus(nn.Dense(self.fields, bias_init=far, name="start")(local))
        distance = min_plus(start, cost, self.sweeps)
        # Only differences along the way matter: measured from the agent, and squashed.
        here = feature_at(distance, agent)
        relative = jnp.tanh((distance - here) / 4)
        source = Convolution(self.channels, name="source")(
            jnp.concatenate([cells, relative], axis=-1)
        )
        step = Convolution(self.channels, name="step")
        h = nn.relu(source)
        for _ in range(self.rounds):
            h = nn.relu(step(h) + source)
        return h


def min_plus(start: jax.Array, cost: jax.Array, sweeps: int) -> jax.Array:
    """Distances `[S, S, F]`: d(c) = min(start(c), cost(c) + min over 4 neighbours of d).

    Args:
        start: `[S, S, F]` the distance of a way that ends in the cell.
        cost: `[S, S, F]` of entering the cell.
        sweeps: rounds; a way of so many cells is found.
    """

    def sweep(distance: jax.Array, _: None) -> tuple[jax.Array, None]:
        padded = jnp.pad(distance, ((1, 1), (1, 1), (0, 0)), constant_values=1e3)
        near = jnp.minimum(
            jnp.minimum(padded[:-2, 1:-1], padded[2:, 1:-1]),
            jnp.minimum(padded[1:-1, :-2], padded[1:-1, 2:]),
        )
        return jnp.minimum(start, cost + near), None

    distance, _ = jax.lax.scan(sweep, start, None, length=sweeps)
    return distance


class CellEmbedding(nn.Module):
    """What is in a cell, as a learned vector: never a raw index taken for a brightness."""

    channels: int

    @nn.compact
    def __call__(self, observation: Observation) -> jax.Array:
        """`[S, S, channels]`, with the agent's and the goal's cell marked."""
        grid = observation.grid.astype(jnp.int32)
        side = grid.shape[0]
        cells = nn.Embed(OBJECTS, self.channels, name="object")(grid[..., 0])
        cells += nn.Embed(COLOURS, self.channels, name="colour")(grid[..., 1])
        cells += nn.Embed(STATES, self.channels, name="state")(grid[..., 2])
        marks = jnp.stack(
            [one_cell(observation.pose[:2], side), one_cell(observation.goal, side)], axis=-1
        )
        return cells + nn.Dense(self.channels, use_bias=False, name="marks")(marks)


def one_cell(position: jax.Array, side: int) -> jax.Array:
    """`[S, S]` float32: 1 at a position `[2]`, all 0 for one outside the grid."""
    axis = jnp.arange(side)
    hit = (axis == position[0])[:, None] & (axis == position[1])[None, :]
    return hit.astype(jnp.float32)


def neighbourhood(image: jax.Array, position: jax.Array, radius: int = 1) -> jax.Array:
    """The `(2 r + 1)^2 * C` features around a position, zero beyond the border."""
    padded = jnp.pad(image, ((radius, radius), (radius, radius), (0, 0)))
    size = 2 * radius + 1
    start = (position[0], position[1], 0)
    return jax.lax.dynamic_slice(padded, start, (size, size, image.shape[-1])).reshape(-1)


def feature_at(image: jax.Array, position: jax.Array) -> jax.Array:
    """The features `[C]` of a cell, zero where the position is -1 (not available)."""
    return jnp.einsum("xyc,xy->c", image, one_cell(position, image.shape[0]))


def projection(features: int, name: str) -> nn.Dense:
    """A linear read-out into the transformer's width."""
    layer = dense(features, scale=0.1)
    return layer.clone(name=name)
