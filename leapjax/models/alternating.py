"""A network that predicts states and actions in turn, for planning from left to right."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.data import windows
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.plans import check_plan, forbid_early_end
from leapjax.models.transformer import (
    KeysValues,
    Transformer,
    causal_mask,
    dense,
    embed,
    interleave,
)
from leapjax.types import Context


class Memory(NamedTuple):
    """The part of a pass that all plans from one context share.

    Attributes:
        known: keys and values per layer of the tokens up to the current state, with empty slots for
            the tokens of a plan.
        first: logits `[A]` of the first action.
    """

    known: list[KeysValues]
    first: jax.Array


class AlternatingModel(nn.Module):
    """Tokens s_1 a_1 s_2 a_2 ... s_T with causal attention.

    The token of a state predicts the next action, and the token of an action predicts the next
    state. A predicted state is a vector `[D]`: the network's own encoding of the observed state.
    With architecture `paper` the tokens of past states and actions come first. With architecture
    `leapjax` the encoder summarises the past.

    Attributes:
        config: architecture and size of the network.
        sizes: sizes of contexts and plans.
        encoder: encoder of the domain, with tokens `[K + 1, D]` or `[C, D]` of a context.
    """

    config: ModelConfig
    sizes: Sizes
    encoder: Encoder

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        self.action = embed(sizes.num_actions + 2, c.width)
        zeros = nn.initializers.zeros
        tokens = 2 * (self.past + sizes.horizon)
        self.position = nn.Embed(tokens, c.width, embedding_init=zeros)
        self.summary = dense(c.width, scale=0.1)
        # Without a learned scale: training would shrink the states, to predict them more easily.
        self.norm = nn.LayerNorm(use_scale=False, use_bias=False)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.choose = dense(sizes.num_actions, use_bias=False)
        self.predict = dense(c.width)

    @property
    def past(self) -> int:
        """Number of past states that have a token each."""
        return self.sizes.context if self.config.architecture == "paper" else 0

    def encode(self, context: Context) -> tuple[jax.Array, jax.Array]:
        """Encodes the states `[past + 1, D]`; also returns the actions `[past]` between them."""
        return self._states(self.encoder(context)), context.actions[
            context.actions.shape[0] - self.past :
        ]

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens of B unrolled windows.

        With architecture `paper` they are `[B, K + T, D]`, a token for each state. With `leapjax`
        they are `[B, T, C, D]`, the C tokens of the context at each of the plan's T states.
        """
        if self.config.architecture == "paper":
            return self.encoder.encode_batch(contexts)

        def at(place: int) -> Context:
            return jax.vmap(lambda each: windows.context_at(each, place, self.sizes.context))(
                contexts
            )

        places = range(self.sizes.horizon)
        return jnp.stack([self.encoder.encode_batch(at(place)) for place in places], axis=1)

    def encode_unrolled(self, context: Context, tokens: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns states `[past + T, D]` and actions `[past + T - 1]` of an unrolled window.

        Args:
            context: context of the window.
            tokens: row of the result of `encode_batch`.
        """
        count = self.past + self.sizes.horizon
        actions = context.actions[context.actions.shape[0] - (count - 1) :]
        if self.config.architecture == "paper":
            return self._states(tokens), actions
        return jnp.concatenate([self._states(each) for each in tokens]), actions

    def _states(self, tokens: jax.Array) -> jax.Array:
        if self.config.architecture != "paper":
            tokens = tokens.reshape(1, -1)
        return self.norm(self.summary(tokens))

    def _tokens(self, states: jax.Array, actions: jax.Array) -> jax.Array:
        """Returns tokens `[2 n - 1, D]` of n states and the actions between them."""
        tokens = interleave(states, jnp.tanh(self.action(actions)))
        return tokens + self.position(jnp.arange(tokens.shape[0]))

    def read(
        self, states: jax.Array, actions: jax.Array, deterministic: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """Predicts each action, logits `[T, A]`, and the states `[T - 1, D]` after the actions.

        Args:
            states: encoded states `[past + T, D]`.
            actions: actions `[past + T - 1]` between the states.
            deterministic: whether to leave out dropout.
        """
        tokens = self._tokens(states, actions)
        h = self.transformer(
            self.drop(tokens, deterministic=deterministic),
            jnp.arange(2 * self.past, tokens.shape[0]),
            mask=causal_mask(tokens.shape[0]), deterministic=deterministic,
        )  # fmt: skip
        return self.choose(h[::2]), self.norm(self.predict(h[1::2]))

    def make_memory(self, context: Context) -> Memory:
        """Encodes a context, once for all plans."""
        states, actions = self.encode(context)
        x = self._tokens(states, actions)
        room = self.transformer.make_empty_memory(2 * (self.past + self.sizes.horizon) - 1)
        h, memory = self.transformer.extend(x, room, 0)
        return Memory(memory, self.choose(h[-1]))

    def logits(self, memory: Memory, actions: jax.Array, positions: jax.Array) -> jax.Array:
        """Returns logits `[P, A]` at some positions of a plan, given the actions before each.

        The network predicts the states in between.

        Args:
            memory: result of `make_memory`.
            actions: plan `[T]`, which may hold MASK.
            positions: positions `[P]`.
        """
        check_plan(actions, self.sizes.horizon)
        embedded = jnp.tanh(self.action(actions))

        def take_action(
            place: int | jax.Array, carry: tuple[list[KeysValues], jax.Array]
        ) -> tuple[list[KeysValues], jax.Array]:
            """Appends an action and the predicted next state; stores the next logits."""
            known, logits = carry
            token = 2 * (self.past + place) + 1
            h, known = self.transformer.extend(
                (embedded[place] + self.position(token))[None], known, token
            )
            state = self.norm(self.predict(h)) + self.position(token + 1)
            h, known = self.transformer.extend(state, known, token + 1)
            return known, logits.at[place + 1].set(self.choose(h[0]))

        logits = jnp.zeros((self.sizes.horizon, self.sizes.num_actions)).at[0].set(memory.first)
        # The loop stops at the last queried position.
        _, logits = jax.lax.fori_loop(0, positions.max(), take_action, (memory.known, logits))
        return forbid_early_end(logits[positions], positions)
