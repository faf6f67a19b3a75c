"""A pre-norm transformer whose keys and values of a fixed prefix are computed once.

`Transformer.prefix` runs the prefix tokens through all layers among themselves;
`Transformer.__call__` runs the tokens that change, which also attend to the prefix, and
computes the last layer only where it is asked for. All for one sequence, `[tokens, D]`.
"""

from collections.abc import Callable
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

WEIGHT_SCALE = 0.02  # normal initialisation of GPT-2, as in the authors' code


class KeysValues(NamedTuple):
    """What one layer remembers of a sequence."""

    keys: jax.Array  # [tokens, heads, D / heads]
    values: jax.Array  # [tokens, heads, D / heads]


def dense(
    features: int,
    use_bias: bool = True,
    scale: float = WEIGHT_SCALE,
    name: str | None = None,
    dtype: Dtype | None = None,
) -> nn.Dense:
    """A linear layer with the initialisation of this transformer."""
    init = nn.initializers.normal(scale)
    return nn.Dense(features, use_bias, dtype=dtype, kernel_init=init, name=name)


def embed(count: int, width: int, name: str | None = None) -> nn.Embed:
    """A table of embeddings with the initialisation of this transformer."""
    return nn.Embed(count, width, embedding_init=_small, name=name)


def _small(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> jax.Array:
    return nn.initializers.normal(WEIGHT_SCALE)(key, shape, dtype)


def causal_mask(tokens: int, prefix: int = 0) -> jax.Array:
    """`[tokens, prefix + tokens]`: each token sees the prefix, itself and those before it."""
    return jnp.tril(jnp.ones((tokens, prefix + tokens), bool), prefix)


def interleave(*sequences: jax.Array) -> jax.Array:
    """One token of each in turn, `[k n - 1, D]`: k sequences `[n, D]`, the last of `[n - 1, D]`."""
    *whole, last = sequences
    last = jnp.concatenate([last, jnp.zeros_like(whole[0][:1])])
    return jnp.stack([*whole, last], axis=1).reshape(-1, last.shape[1])[:-1]


class Block(nn.Module):
    """One layer: attention, then a two-layer perceptron, each on a normalised residual.

    With a `dtype` of lower precision the matrix products have it, as have keys and values;
    parameters, the residual, the statistics of norms and the softmax stay float32.
    """

    width: int  # D
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
        """What others attend to in tokens `[tokens, D]`."""
        h = self.norm_attention(x)
        return KeysValues(self._heads(self.key(h)), self._heads(self.value(h)))

    def __call__(
        self, x: jax.Array, memory: KeysValues, mask: jax.Array | None, deterministic: bool
    ) -> jax.Array:
        """Tokens `[Q, D]` after this layer, attending to `memory` where `mask [Q, M]` is."""
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
    """Layers of `Block` and a final norm."""

    layers: int
    width: int  # D
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
        """Keys and values, per layer, of prefix tokens `[M, D]` that see only each other.

        `mask [M, M]` is False where a token (row) may not attend to another (column).
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
        """Outputs `[Q, D]` at token indices `queried [Q]` of tokens `x [tokens, D]`.

        Every token attends to the prefix, where it is given, and to all tokens; or only where
        `mask [tokens, prefix + tokens]` is True (see `causal_mask`).
        """
        for index, block in enumerate(self.blocks):
            memory = block.keys_values(x)
            if prefix is not None:
                memory = KeysValues(
                    *(jnp.concatenate(pair) for pair in zip(prefix[index], memory, strict=True))
                )
            if index == self.layers - 1:
                x = x[queried]
                mask = None if mask is None else mask[queried]
            x = block(x, memory, mask, deterministic)
        return self.norm(x)

    def nothing_yet(self, tokens: int) -> list[KeysValues]:
        """Room for the keys and values of so many tokens, per layer, for `extend`."""
        empty = jnp.zeros((tokens, self.heads, self.width // self.heads), self.dtype)
        return [KeysValues(empty, empty)] * self.layers

    def extend(
        self, x: jax.Array, memory: list[KeysValues], start: jax.Array | int
    ) -> tuple[jax.Array, list[KeysValues]]:
        """Outputs `[n, D]` of the tokens `x [n, D]` that come next, with causal attention.

        The same as of `__call__` with a `causal_mask`, a few tokens at a time, without dropout.

        Args:
            x: tokens number `start` and after.
            memory: of the tokens before them, with room for more.
            start: `[]` how many there are before.
        """
        slots = jnp.arange(memory[0].keys.shape[0])
        mask = slots <= start + jnp.arange(x.shape[0])[:, None]
        extended = []
        for block, old in zip(self.blocks, memory, strict=True):
            new = block.keys_values(x)
            joined = KeysValues(
                *(
                    jax.lax.dynamic_update_slice_in_dim(all_, some, start, axis=0)
                    for all_, some in zip(old, new, strict=True)
                )
            )
            extended.append(joined)
            x = block(x, joined, mask, True)
        return self.norm(x), extended
