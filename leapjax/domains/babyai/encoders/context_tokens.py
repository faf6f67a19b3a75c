"""Our encoder: a few tokens for a whole context."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

from leapjax.domains.babyai import symmetries, vocabulary
from leapjax.domains.babyai.adapter import NUM_ACTIONS
from leapjax.domains.babyai.encoders.cells import (
    COLOURS,
    OBJECTS,
    CellEmbedding,
    mark_cell,
    read_cell,
    read_neighbourhood,
)
from leapjax.domains.babyai.encoders.distances import GridEncoder
from leapjax.domains.babyai.encoders.instructions import InstructionEncoder, WordAttention
from leapjax.domains.babyai.settings import Settings
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense, embed
from leapjax.types import Context, pad_token


class ContextTokens(Encoder):
    """Our encoder: four tokens for a whole context.

    It turns the grid so that the agent faces right, and computes learned distances on it. Then it
    reads the grid at the agent, at the goal and as a whole.

    Attributes:
        settings: sizes of the encoder.
        width: D, width of a token.
        dtype: type of convolutions.
    """

    settings: Settings
    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:
        """Computes tokens `[4, D]`: the agent, the goal, the whole grid, the instruction."""
        c, side = self.settings, context.observation.grid.shape[0]
        direction = context.observation.pose[2]
        observation = symmetries.rotate(context.observation, direction)
        words = InstructionEncoder(vocabulary.SIZE, self.width, name="instruction")
        instruction = words(observation.instruction)
        cells = CellEmbedding(c.channels, name="cells")(observation)
        if context.actions.shape[0]:
            faced = self._mark_faced(context, observation.grid)
            cells += nn.Dense(c.channels, use_bias=False, name="faced")(faced)
        scale, shift = jnp.split(dense(2 * c.channels, name="modulation")(instruction.whole), 2)
        modulated = cells * (1 + scale) + shift
        if c.word_heads:
            modulated += WordAttention(c.word_heads, name="words")(cells, instruction)
        encoder = GridEncoder(c.channels, c.fields, c.sweeps, c.rounds, self.dtype, name="grid")
        grid, distances = encoder(modulated, observation.pose[:2], observation.goal)

        def read(features: jax.Array, name: str) -> jax.Array:
            return dense(self.width, scale=0.1, name=name)(features)

        # The first steps of a plan depend on the agent's neighbourhood.
        around = read_neighbourhood(grid, observation.pose[:2], c.radius)
        kind, colour = observation.carried
        agent = read(around, "read_agent")
        if c.fields:
            agent += read(distances, "read_distances")
        agent += embed(OBJECTS, self.width, "carried")(kind)
        agent += embed(COLOURS, self.width, "carried_colour")(colour)
        goal = read(read_cell(grid, observation.goal), "read_goal")
        whole = read(grid.reshape(side * side, -1).max(axis=0), "read_all")
        return jnp.stack([agent, goal, whole, instruction.whole])

    def _mark_faced(self, context: Context, turned: jax.Array) -> jax.Array:
        """Marks the objects and doors that the agent has faced in the context: `[S, S, 2]`.

        The first feature is 1 on these cells. The second says how recently the agent faced them, in
        (0, 1], where 1 is now. Both show which part of an instruction is done. The encoder leaves
        out past actions and the rest of the agent's path, because a network could recognise a
        demonstration by them.

        Args:
            context: context with K past steps.
            turned: current grid `[S, S, 3]`, turned so that the agent faces right.
        """
        side, past = turned.shape[0], context.actions.shape[0]
        direction = context.observation.pose[2]
        poses = jnp.concatenate([context.past.pose, context.observation.pose[None]])
        known = jnp.append(context.actions != pad_token(NUM_ACTIONS), True)
        recency = known * jnp.arange(1, past + 2) / (past + 1)

        def mark(pose: jax.Array) -> jax.Array:
            pose = symmetries.rotate_pose(pose, direction, side)
            front = pose[:2] + jnp.asarray(symmetries.DIRECTION_VECTORS)[pose[2]]
            return mark_cell(front, side)

        kinds = turned[..., 0]
        named = (kinds >= symmetries.FIRST_COLOURED) & (kinds <= symmetries.LAST_COLOURED)
        latest = (jax.vmap(mark)(poses) * recency[:, None, None]).max(axis=0) * named
        return jnp.stack([latest > 0, latest], axis=-1)
