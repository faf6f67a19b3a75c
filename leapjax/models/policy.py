"""The network of methods that choose one action at a time: causal attention over a context."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.models.trajectory import ModelConfig, Sizes
from leapjax.models.transformer import Transformer, causal_mask, dense, embed
from leapjax.types import Context, PyTree


class PolicyModel(nn.Module):
    """Logits, values or whatever a method needs, read off the states of a context.

    Architecture `paper`: tokens s_1 a_1 s_2 a_2 ... s_n, each of which sees those before it, and
    something is said at every state. Architecture `leapjax`: the encoder's few tokens and one
    that asks, so that something is said at the current state only. `P` states in all.
    """

    config: ModelConfig
    sizes: Sizes
    encoder: nn.Module  # the domain's: context -> [K + 1, D], or [C, D]
    heads: tuple[tuple[str, int], ...]  # what is said: a name, and how many numbers

    def setup(self) -> None:  # noqa: D102
        c = self.config
        if c.architecture == "paper":
            self.action = embed(self.sizes.num_actions + 2, c.width)
            zeros = nn.initializers.zeros
            self.position = nn.Embed(2 * self.sizes.context + 1, c.width, embedding_init=zeros)
            self.time = nn.Embed(self.sizes.max_steps + 1, c.width, embedding_init=zeros)
        else:
            self.question = embed(1, c.width)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.said = [dense(count, name=name) for name, count in self.heads]

    def __call__(self, context: Context, deterministic: bool = True) -> dict[str, jax.Array]:
        """What each head says, `[P, count]`, at the last P states, the current one last."""
        read = self._sequence if self.config.architecture == "paper" else self._question
        h = read(context, deterministic)
        return {name: said(h) for (name, _), said in zip(self.heads, self.said, strict=True)}

    def _sequence(self, context: Context, deterministic: bool) -> jax.Array:
        states = self.encoder(context)  # [K + 1, D]
        actions = jnp.tanh(self.action(context.actions))  # [K, D]
        pairs = jnp.stack([states[:-1], actions], axis=1).reshape(-1, self.config.width)
        tokens = jnp.concatenate([pairs, states[-1:]])  # [2 K + 1, D]
        tokens += self.position(jnp.arange(tokens.shape[0]))
        tokens += self.time(jnp.minimum(context.step, self.sizes.max_steps))
        return self.transformer(
            self.drop(tokens, deterministic=deterministic),
            2 * jnp.arange(states.shape[0]),
            mask=causal_mask(tokens.shape[0]), deterministic=deterministic,
        )  # fmt: skip

    def _question(self, context: Context, deterministic: bool) -> jax.Array:
        tokens = self.drop(self.encoder(context), deterministic=deterministic)
        memory = self.transformer.prefix(tokens, deterministic=deterministic)
        first = jnp.zeros(1, jnp.int32)
        return self.transformer(self.question(first), first, memory, deterministic=deterministic)


def past_and_present(past: jax.Array, present: jax.Array, count: int) -> PyTree:
    """What belongs to each of the last `count` states: `[K]` and `[]` to `[count]`."""
    return jnp.append(past, present)[past.shape[0] + 1 - count :]
