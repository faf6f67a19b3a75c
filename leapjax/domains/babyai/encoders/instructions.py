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


class CrossAttention(nn.Module):
    """Attention from some things to others, such as from cells to the words of an instruction.

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
    def __call__(self, readers: jax.Array, read: jax.Array, given: jax.Array) -> jax.Array:
        """Computes an update `[..., C]` of readers `[..., C]`.

        Args:
            readers: features of the things that attend.
            read: features `[L, W]` of the things that they attend to.
            given: booleans `[L]`, False for padding.
        """

        def heads(x: jax.Array, name: str) -> jax.Array:
            return nn.DenseGeneral((self.heads, self.features), name=name)(x)

        queries, keys, values = heads(readers, "query"), heads(read, "key"), heads(read, "value")
        scores = jnp.einsum("...hd,lhd->...hl", queries, keys) / self.features**0.5
        weights = jax.nn.softmax(jnp.where(given, scores, -1e30), axis=-1)
        attended = jnp.einsum("...hl,lhd->...hd", weights, values)
        return nn.DenseGeneral(readers.shape[-1], axis=(-2, -1), name="output")(attended)


class InstructionReview(nn.Module):
    """Tells words which of their tasks are done: they look at things, then at each other.

    Attributes:
        heads: number of heads.
    """

    heads: int

    @nn.compact
    def __call__(
        self, instruction: Instruction, things: jax.Array, there: jax.Array
    ) -> Instruction:
        """Computes new features of the words, and adds their largest to the whole.

        Args:
            instruction: encoded instruction.
            things: features `[n, C]` of things, which show what the agent did with them.
            there: booleans `[n]`, False for padding.
        """
        words = instruction.words
        words += CrossAttention(self.heads, name="things")(words, things, there)
        words += CrossAttention(self.heads, name="others")(words, words, instruction.given)
        hidden = nn.relu(nn.Dense(words.shape[-1], name="hidden")(words))
        words += nn.Dense(words.shape[-1], name="update")(hidden)
        largest = jnp.where(instruction.given[:, None], nn.relu(words), 0).max(axis=0)
        whole = instruction.whole + nn.Dense(words.shape[-1], name="whole")(largest)
        return Instruction(words, instruction.given, whole)
