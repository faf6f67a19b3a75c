"""Encodes the instruction, and attends from cells to its words."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Initializer

# Initialisers of embeddings: PyTorch's, which the authors use, and Flax's.
LARGE = nn.initializers.normal(1.0)
SMALL = nn.initializers.variance_scaling(1.0, "fan_in", "normal", out_axis=0)


class Instruction(NamedTuple):
    """An encoded instruction.

    Attributes:
        words: features `[L, width]` of each word in the context of earlier words.
        given: booleans `[L]`, False for padding.
        whole: state `[width]` of the GRU after the last word.
    """

    words: jax.Array
    given: jax.Array
    whole: jax.Array


class InstructionEncoder(nn.Module):
    """Word embeddings and a GRU (paper, appendix, network details).

    Attributes:
        vocabulary: number of token ids.
        width: width of embeddings and of the GRU.
        embedding_init: initialiser of the embeddings.
    """

    vocabulary: int
    width: int
    embedding_init: Initializer = SMALL

    @nn.compact
    def __call__(self, instruction: jax.Array) -> Instruction:
        """Encodes token ids `[L]`, 0 for padding."""
        table = nn.Embed(self.vocabulary, self.width, embedding_init=self.embedding_init)
        words = table(instruction)
        given = instruction > 0
        recurrence = nn.RNN(nn.GRUCell(self.width), return_carry=True)
        whole, states = recurrence(words, seq_lengths=jnp.sum(given))
        return Instruction(words + states, given, whole)


class WordAttention(nn.Module):
    """Attention from cells to the words of an instruction.

    A single vector of 'go to the red ball and the key, then ...' would have to say of every object
    whether and when to go there. With attention, the cell of an object finds the words that name
    it.

    Attributes:
        heads: number of heads.
        features: features of each head.
    """

    heads: int
    features: int = 16

    @nn.compact
    def __call__(self, cells: jax.Array, instruction: Instruction) -> jax.Array:
        """Computes an update `[S, S, C]` of cells `[S, S, C]` from the words."""

        def heads(x: jax.Array, name: str) -> jax.Array:
            return nn.DenseGeneral((self.heads, self.features), name=name)(x)

        words = instruction.words
        queries, keys, values = heads(cells, "query"), heads(words, "key"), heads(words, "value")
        scores = jnp.einsum("xyhd,lhd->xyhl", queries, keys) / self.features**0.5
        weights = jax.nn.softmax(jnp.where(instruction.given, scores, -1e30), axis=-1)
        attended = jnp.einsum("xyhl,lhd->xyhd", weights, values)
        return nn.DenseGeneral(cells.shape[-1], axis=(-2, -1), name="output")(attended)
