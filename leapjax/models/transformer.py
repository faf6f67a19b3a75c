"""A pre-norm transformer that computes the keys and values of a fixed prefix once.

`Transformer.prefix` runs the prefix tokens through all layers. `Transformer.__call__` runs the
other tokens, which also attend to the prefix; it computes the last layer at the queried tokens
only. Both take one sequence, `[tokens, D]`.
"""

from collections.abc import Callable
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

WEIGHT_SCALE = 0.02  # normal initialisation of GPT-2, as in the authors' code


class KeysValues(NamedTuple):
    """Keys and values of a sequence in one layer.

    Attributes:
        keys: `[tokens, heads, D / heads]`.
        values: `[tokens, heads, D / heads]`.
    """

    keys: jax.Array
    values: jax.Array


def dense(
    features: int,
    use_bias: bool = True,
    scale: float = WEIGHT_SCALE,
    name: str | None = None,
    dtype: Dtype | None = None,
) -> nn.Dense:
    """Makes a linear layer with the initialisation of this transformer."""
    init = nn.initializers.normal(scale)
    return nn.Dense(features, use_bias, dtype=dtype, kernel_init=init, name=name)


def embed(count: int, width: int, name: str | None = None) -> nn.Embed:
    """Makes a table of embeddings with the initialisation of this transformer."""
    return nn.Embed(count, width, embedding_init=_small, name=name)


def _small(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> jax.Array:
    return nn.initializers.normal(WEIGHT_SCALE)(key, shape, dtype)


def causal_mask(tokens: int, prefix: int = 0) -> jax.Array:
    """Makes a mask `[tokens, prefix + tokens]` that hides later tokens, but not the prefix."""
    return jnp.tril(jnp.ones((tokens, prefix + tokens), bool), prefix)


def interleave(*sequences: jax.Array) -> jax.Array:
    """Takes one token of each sequence in turn, `[k n - 1, D]`.

    Args:
        sequences: k - 1 sequences `[n, D]`, and a last sequence `[n - 1, D]`.
    """
    *whole, last = sequences
    last = jnp.concatenate([last, jnp.zeros_like(whole[0][:1])])
    return jnp.stack([*whole, last], axis=1).reshape(-1, last.shape[1])[:-1]


class Block(nn.Module):
    """One layer: attention, then a two-layer perceptron, each on a normalised residual.

    Parameters, the residual, the statistics of norms and the softmax are float32.

    Attributes:
        width: D.
        heads: number of attention heads; divides D.
        dropout: dropout rate of attention and residuals.
        activation: activation of the perceptron.
        dtype: type of matrix products, keys and values.
    """

    width: int
    heads: int
    dropout: float
    activation: Callable[[jax.Array], jax.Array]
    dtype: Dtype

    def setup(self) -> None:  # noqa: D102
        self.norm_attention = nn.LayerNorm(dtype=self.dtype)
        self.query = dense(self.width, dtype=self.dtype)
        # A key bias shifts all scores of a query alike, so softmax cannot see it.
        self.key = dense(self.width, use_bias=False, dtype=self.dtype)
        self.value = dense(self.width, dtype=self.dtype)
        self.output = dense(self.width, dtype=self.dtype)
        self.norm_perceptron = nn.LayerNorm(dtype=self.dtype)
        self.expand = dense(4 * self.width, dtype=self.dtype)
        self.contract = dense(self.width, dtype=self.dtype)
        self.drop = nn.Dropout(self.dropout)

    def keys_values(self, x: jax.Array) -> KeysValues:
        """Returns the keys and values of tokens `[tokens, D]`."""
        h = self.norm_attention(x)
        return KeysValues(self._heads(self.key(h)), self._heads(self.value(h)))

    def __call__(
        self, x: jax.Array, memory: KeysValues, mask: jax.Array | None, deterministic: bool
    ) -> jax.Array:
        """Returns tokens `[Q, D]` after this layer.

        Args:
            x: tokens `[Q, D]`.
            memory: keys and values of the M tokens to attend to.
            mask: booleans `[Q, M]`, or `[heads, Q, M]`, True where a token (row) attends to a token
                (column); `None` for full attention.
            deterministic: whether to leave out dropout.
        """
        queries = self._heads(self.query(self.norm_attention(x)))
        scores = jnp.einsum("qhd,mhd->hqm", queries, memory.keys).astype(jnp.float32)
        scores /= jnp.sqrt(self.width / self.heads)
        if mask is not None:
            scores = jnp.where(mask, scores, -1e30)
        weights = self.drop(jax.nn.softmax(scores, axis=-1), deterministic=deterministic)
        weights = weights.astype(self.dtype)
        attended = jnp.einsum("hqm,mhd->qhd", weights, memory.values).reshape(x.shape)
        x = x + self.drop(self.output(attended), deterministic=deterministic)
        h = self.contract(self.activation(self.expand(self.norm_perceptron(x))))
        return x + self.drop(h, deterministic=deterministic)

    def _heads(self, x: jax.Array) -> jax.Array:
        return x.reshape(x.shape[0], self.heads, self.width // self.heads)


class Transformer(nn.Module):
    """Layers of `Block` and a final norm.

    Attributes:
        layers: number of blocks.
        width: D.
        heads: number of attention heads; divides D.
        dropout: dropout rate of attention and residuals.
        activation: activation of the perceptrons.
        dtype: type of matrix products, keys and values.
    """

    layers: int
    width: int
    heads: int
    dropout: float = 0.0
    activation: Callable[[jax.Array], jax.Array] = nn.gelu
    dtype: Dtype = jnp.float32

    def setup(self) -> None:  # noqa: D102
        self.blocks = [
            Block(self.width, self.heads, self.dropout, self.activation, self.dtype)
            for _ in range(self.layers)
        ]
        self.norm = nn.LayerNorm()

    def prefix(
        self, x: jax.Array, mask: jax.Array | None = None, deterministic: bool = True
    ) -> list[KeysValues]:
        """Returns the keys and values, per layer, of prefix tokens, which see only each other.

        Args:
            x: prefix tokens `[M, D]`.
            mask: booleans `[M, M]`, True where a token (row) attends to a token (column); `None`
                for full attention.
            deterministic: whether to leave out dropout.
        """
        memory = []
        for block in self.blocks[:-1]:
            memory.append(block.keys_values(x))
            x = block(x, memory[-1], mask, deterministic)
        return [*memory, self.blocks[-1].keys_values(x)]

    def __call__(
        self,
        x: jax.Array,
        queried: jax.Array,
        prefix: list[KeysValues] | None = None,
        mask: jax.Array | None = None,
        deterministic: bool = True,
    ) -> jax.Array:
        """Returns the outputs `[Q, D]` at some tokens of a sequence.

        Args:
            x: tokens `[tokens, D]`.
            queried: indices `[Q]` of the tokens to return.
            prefix: keys and values of the prefix, from `prefix`; `None` without a prefix.
            mask: booleans `[tokens, prefix + tokens]`, True where a token (row) attends to a token
                (column), see `causal_mask`; `[heads, tokens, prefix + tokens]` for a mask of each
                head; `None` for full attention.
            deterministic: whether to leave out dropout.
        """
        for index, block in enumerate(self.blocks):
            memory = block.keys_values(x)
            if prefix is not None:
                memory = KeysValues(
                    *(jnp.concatenate(pair) for pair in zip(prefix[index], memory, strict=True))
                )
            if index == self.layers - 1:
                x = x[queried]
                mask = None if mask is None else mask[..., queried, :]
            x = block(x, memory, mask, deterministic)
        return self.norm(x)

    def make_empty_memory(self, tokens: int) -> list[KeysValues]:
        """Makes zeros, per layer, in which `extend` stores keys and values of `tokens` tokens."""
        empty = jnp.zeros((tokens, self.heads, self.width // self.heads), self.dtype)
        return [KeysValues(empty, empty)] * self.layers

    def extend(
        self, x: jax.Array, memory: list[KeysValues], start: jax.Array | int
    ) -> tuple[jax.Array, list[KeysValues]]:
        """Appends a few tokens to a sequence: `__call__` with a `causal_mask`, without dropout.

        Args:
            x: next n tokens, `[n, D]`.
            memory: keys and values of the earlier tokens, per layer, with empty slots for the new.
            start: number `[]` of earlier tokens.

        Returns:
            The outputs `[n, D]`, and the extended memory.
        """
        slots = jnp.arange(memory[0].keys.shape[0])
        mask = slots <= start + jnp.arange(x.shape[0])[:, None]
        extended = []
        for block, old in zip(self.blocks, memory, strict=True):
            new = block.keys_values(x)
            joined = KeysValues(
                *(
                    jax.lax.dynamic_update_slice_in_dim(before, added, start, axis=0)
                    for before, added in zip(old, new, strict=True)
                )
            )
            extended.append(joined)
            x = block(x, joined, mask, True)
        return self.norm(x), extended
