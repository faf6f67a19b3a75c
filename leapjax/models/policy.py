"""The network of methods that choose one action at a time: causal attention over a context."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.data import windows
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import Transformer, causal_mask, dense, embed, interleave
from leapjax.types import Context

Outputs = dict[str, jax.Array]  # by head: [P, outputs of the head]


class PolicyModel(nn.Module):
    """Linear heads (logits, values, features) on the last P states of a context.

    Architecture `paper` reads every state, P = K + 1: tokens s_1 a_1 s_2 a_2 ... s_n with causal
    attention. Architecture `leapjax` reads the current state, P = 1: the encoder's few tokens, and
    a query token.

    A network may be conditioned on returns to go (Chen et al., Decision Transformer). Architecture
    `paper` then has a return token before each state token. Architecture `leapjax` adds the
    return's embedding to the query.

    Attributes:
        config: architecture and size of the network.
        sizes: sizes of contexts.
        encoder: encoder of the domain, with tokens `[K + 1, D]` or `[C, D]` of a context.
        heads: name and number of outputs of each head.
        conditioned: whether the network is conditioned on returns to go.
    """

    config: ModelConfig
    sizes: Sizes
    encoder: Encoder
    heads: tuple[tuple[str, int], ...]
    conditioned: bool = False

    def setup(self) -> None:  # noqa: D102
        c = self.config
        if c.architecture == "paper":
            self.action = embed(self.sizes.num_actions + 2, c.width)
            zeros = nn.initializers.zeros
            tokens = (3 if self.conditioned else 2) * (self.sizes.context + 1) - 1
            self.position = nn.Embed(tokens, c.width, embedding_init=zeros)
            self.time = nn.Embed(self.sizes.max_steps + 1, c.width, embedding_init=zeros)
        else:
            self.question = embed(1, c.width)
        if self.conditioned:
            self.goal = dense(c.width, scale=1.0)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.outputs = [dense(count, name=name) for name, count in self.heads]

    def __call__(
        self,
        context: Context,
        deterministic: bool = True,
        returns: jax.Array | None = None,
        tokens: jax.Array | None = None,
    ) -> Outputs:
        """Returns the outputs of each head at the last P states, the current state last.

        Args:
            context: context to read.
            deterministic: whether to leave out dropout.
            returns: returns to go `[K + 1]` at each state; `None` if not conditioned.
            tokens: encoder's tokens, from `encode_batch` or `encode_next`; if `None`, the network
                encodes the context.
        """
        tokens = self.encoder(context) if tokens is None else tokens
        return self._apply_heads(tokens, context, deterministic, returns)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens `[B, C, D]` of B contexts."""
        return self.encoder.encode_batch(contexts)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the encoder's tokens of a context, given the tokens of its past states."""
        return self.encoder.encode_next(context, known)

    def encode_transitions(self, contexts: Context) -> tuple[jax.Array, jax.Array]:
        """Returns the encoder's tokens before and after the steps of transitions, `[B, C, D]` each.

        Args:
            contexts: contexts of B `TransitionWindow`s.
        """
        if self.config.architecture != "paper":
            earlier, later = (jax.vmap(f)(contexts) for f in (windows.before, windows.after))
            return self.encode_batch(earlier), self.encode_batch(later)
        states = self.encode_batch(contexts)  # [B, K + 2, D]: each state is encoded once
        return states[:, :-1], states[:, 1:]

    def apply_transition(
        self, context: Context, tokens: tuple[jax.Array, jax.Array], deterministic: bool = True
    ) -> tuple[Outputs, Outputs]:
        """Returns the outputs before and after the step of a transition.

        Args:
            context: context of the `TransitionWindow`.
            tokens: rows of the results of `encode_transitions`, `[C, D]` each.
            deterministic: whether to leave out dropout.
        """
        earlier, later = tokens
        return (
            self._apply_heads(earlier, windows.before(context), deterministic, None),
            self._apply_heads(later, windows.after(context), deterministic, None),
        )

    def _apply_heads(
        self, tokens: jax.Array, context: Context, deterministic: bool, returns: jax.Array | None
    ) -> Outputs:
        goals = None if returns is None else jnp.tanh(self.goal(returns[:, None]))  # [K + 1, D]
        read = self._read_sequence if self.config.architecture == "paper" else self._read_query
        h = read(tokens, context, deterministic, goals)
        return {name: head(h) for (name, _), head in zip(self.heads, self.outputs, strict=True)}

    def _read_sequence(
        self, states: jax.Array, context: Context, deterministic: bool, goals: jax.Array | None
    ) -> jax.Array:
        actions = jnp.tanh(self.action(context.actions))  # [K, D]
        each = [states, actions] if goals is None else [goals, states, actions]
        tokens = interleave(*each)
        tokens += self.position(jnp.arange(tokens.shape[0]))
        tokens += self.time(jnp.minimum(context.step, self.sizes.max_steps))
        return self.transformer(
            self.drop(tokens, deterministic=deterministic),
            len(each) * jnp.arange(states.shape[0]) + len(each) - 2,
            mask=causal_mask(tokens.shape[0]), deterministic=deterministic,
        )  # fmt: skip

    def _read_query(
        self, tokens: jax.Array, context: Context, deterministic: bool, goals: jax.Array | None
    ) -> jax.Array:
        del context
        tokens = self.drop(tokens, deterministic=deterministic)
        memory = self.transformer.prefix(tokens, deterministic=deterministic)
        first = jnp.zeros(1, jnp.int32)
        query = self.question(first) if goals is None else self.question(first) + goals[-1:]
        return self.transformer(query, first, memory, deterministic=deterministic)


def append_present(past: jax.Array, present: jax.Array, count: int) -> jax.Array:
    """Appends the current state's value to the past values, and keeps the last `count`.

    Args:
        past: values `[K]` of the past states.
        present: value `[]` of the current state.
        count: number of values to keep, at most K + 1.
    """
    return jnp.append(past, present)[past.shape[0] + 1 - count :]
