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
    """What all plans from one context share."""

    known: list[KeysValues]  # of the tokens up to the current state, per layer, with room for more
    first: jax.Array  # [A] logits of the first action


class AlternatingModel(nn.Module):
    """Tokens s_1 a_1 s_2 a_2 ... s_T, each of which sees those before it.

    An action is read off its state, and off an action the state that it leads to, as a vector:
    the encoding that the network has of states that it sees. Architecture `paper` has the past
    before that, in the same way; of architecture `leapjax` the encoder knows it.
    """

    config: ModelConfig
    sizes: Sizes
    encoder: Encoder  # the domain's: context -> [K + 1, D], or [C, D]

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        self.action = embed(sizes.num_actions + 2, c.width)
        zeros = nn.initializers.zeros
        tokens = 2 * (self.past + sizes.horizon)
        self.position = nn.Embed(tokens, c.width, embedding_init=zeros)
        self.summary = dense(c.width, scale=0.1)
        # Without weights, so that a vector cannot be made easy to predict by making it small.
        self.norm = nn.LayerNorm(use_scale=False, use_bias=False)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.choose = dense(sizes.num_actions, use_bias=False)
        self.predict = dense(c.width)

    @property
    def past(self) -> int:
        """Past states that are tokens of their own."""
        return self.sizes.context if self.config.architecture == "paper" else 0

    def encode(self, context: Context) -> tuple[jax.Array, jax.Array]:
        """States `[past + 1, D]` up to the current one, and the actions `[past]` between them."""
        return self._states(self.encoder(context)), context.actions[
            context.actions.shape[0] - self.past :
        ]

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens of B unrolled windows.

        Architecture `paper`: `[B, K + T, D]`, each state is encoded once; `leapjax`:
        `[B, T, C, D]`, those of the context at each state of the plan.
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
        """The same of an unrolled window: states `[past + T, D]`, actions `[past + T - 1]`.

        Args:
            context: of the window.
            tokens: its row of what `encode_batch` returned.
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
        """`[2 n - 1, D]` of n states and the actions between them."""
        tokens = interleave(states, jnp.tanh(self.action(actions)))
        return tokens + self.position(jnp.arange(tokens.shape[0]))

    def read(
        self, states: jax.Array, actions: jax.Array, deterministic: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """Logits `[T, A]` of each action of the plan, and the states `[T - 1, D]` they lead to.

        Args:
            states: `[past + T, D]`.
            actions: `[past + T - 1]` those between them.
            deterministic: without dropout.
        """
        tokens = self._tokens(states, actions)
        h = self.transformer(
            self.drop(tokens, deterministic=deterministic),
            jnp.arange(2 * self.past, tokens.shape[0]),
            mask=causal_mask(tokens.shape[0]), deterministic=deterministic,
        )  # fmt: skip
        return self.choose(h[::2]), self.norm(self.predict(h[1::2]))

    def begin(self, context: Context) -> Memory:
        """What every plan from here on shares."""
        states, actions = self.encode(context)
        x = self._tokens(states, actions)
        room = self.transformer.nothing_yet(2 * (self.past + self.sizes.horizon) - 1)
        h, memory = self.transformer.extend(x, room, 0)
        return Memory(memory, self.choose(h[-1]))

    def logits(self, memory: Memory, actions: jax.Array, positions: jax.Array) -> jax.Array:
        """Logits `[P, A]` at `positions [P]`, given the actions before each: states are predicted.

        Args:
            memory: from `begin`.
            actions: `[T]`; what is not chosen yet may be MASK.
            positions: P of them.
        """
        check_plan(actions, self.sizes.horizon)
        embedded = jnp.tanh(self.action(actions))

        def go_on(
            place: int | jax.Array, carry: tuple[list[KeysValues], jax.Array]
        ) -> tuple[list[KeysValues], jax.Array]:
            """One action, the state that it leads to, and the logits of the next."""
            known, chosen = carry
            token = 2 * (self.past + place) + 1
            h, known = self.transformer.extend(
                (embedded[place] + self.position(token))[None], known, token
            )
            state = self.norm(self.predict(h)) + self.position(token + 1)
            h, known = self.transformer.extend(state, known, token + 1)
            return known, chosen.at[place + 1].set(self.choose(h[0]))

        chosen = jnp.zeros((self.sizes.horizon, self.sizes.num_actions)).at[0].set(memory.first)
        # Only as far as is asked for.
        _, chosen = jax.lax.fori_loop(0, positions.max(), go_on, (memory.known, chosen))
        return forbid_early_end(chosen[positions], positions)
