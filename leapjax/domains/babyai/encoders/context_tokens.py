"""Our encoder: a few tokens for a whole context."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

from leapjax.domains.babyai import symmetries, vocabulary
from leapjax.domains.babyai.encoders.cells import (
    COLOURS,
    OBJECTS,
    OUTSIDE,
    CellEmbedding,
    find_things,
    read_cell,
    read_neighbourhood,
)
from leapjax.domains.babyai.encoders.distances import GridEncoder
from leapjax.domains.babyai.encoders.instructions import (
    CrossAttention,
    InstructionEncoder,
    InstructionReview,
)
from leapjax.domains.babyai.encoders.memory import mark_faced, recall
from leapjax.domains.babyai.settings import Settings
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense, embed
from leapjax.types import Context


class ContextTokens(Encoder):
    """Our encoder: four tokens for a whole context.

    It turns the grid so that the agent faces right, and computes learned distances on it. Then it
    reads the grid at the agent, at the goal and as a whole. The tokens do not depend on the padding
    of the grid or the instruction, so one network plays levels of any size.

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
            faced = mark_faced(context, observation.grid)
            cells += nn.Dense(c.channels, use_bias=False, name="faced")(faced)
        inside = (observation.grid[..., :1] != OUTSIDE).astype(cells.dtype)
        if c.memory:
            recalled = recall(context, observation)
            cells += nn.Dense(c.channels, use_bias=False, name="deeds")(recalled)
            places = find_things(observation)
            things = cells.reshape(side * side, -1).at[places].get(mode="fill", fill_value=0)
            review = InstructionReview(c.word_heads, name="review")
            instruction = review(instruction, things, places < side * side)
        scale, shift = jnp.split(dense(2 * c.channels, name="modulation")(instruction.whole), 2)
        modulated = cells * (1 + scale) + shift
        attention = CrossAttention(c.word_heads, name="words") if c.word_heads else None
        if attention and c.memory:  # of things only: most cells are walls or empty
            told = attention(things, instruction.words, instruction.given)
            flat = modulated.reshape(side * side, -1).at[places].add(told, mode="drop")
            modulated = flat.reshape(modulated.shape)
        elif attention:
            modulated += attention(cells, instruction.words, instruction.given)
        encoder = GridEncoder(c.channels, c.fields, c.sweeps, c.rounds, self.dtype, name="grid")
        grid, distances = encoder(modulated, inside, observation.pose[:2], observation.goal)

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
