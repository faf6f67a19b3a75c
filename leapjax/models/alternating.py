"""A network that predicts states and actions in turn, for planning from left to right."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.data import windows
from leapjax.models.trajectory import ModelConfig, Sizes, check_plan, forbid_early_end
from leapjax.models.transformer import Transformer, causal_mask, dense, embed
from leapjax.types import Context


class AlternatingModel(nn.Module):
    """Tokens s_1 a_1 s_2 a_2 ... s_T, each of which sees those before it.

    An action is read off its state, and off an action the state that it leads to, as a vector:
    the encoding that the network has of states that it sees. Architecture `paper` has the past
    before that, in the same way; of architecture `leapjax` the encoder knows it.
    """

    config: ModelConfig
    sizes: Sizes
    encoder: nn.Module  # the domain's: context -> [K + 1, D], or [C, D]

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
        return self._states(context), context.actions[context.actions.shape[0] - self.past :]

    def encode_unrolled(self, context: Context) -> tuple[jax.Array, jax.Array]:
        """The same of an unrolled window: states `[past + T, D]`, actions `[past + T - 1]`."""
        count = self.past + self.sizes.horizon
        if self.config.architecture == "paper":
            states = self._states(context)  # each is encoded once
        else:
            places = range(self.sizes.horizon)
            contexts = [windows.context_at(context, n, self.sizes.context) for n in places]
            states = jnp.concatenate([self._states(each) for each in contexts])
        return states, context.actions[context.actions.shape[0] - (count - 1) :]

    def _states(self, context: Context) -> jax.Array:
        tokens = self.encoder(context)
        if self.config.architecture != "paper":
            tokens = tokens.reshape(1, -1)
        return self.norm(self.summary(tokens))

    def read(
        self, states: jax.Array, actions: jax.Array, deterministic: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """Logits `[T, A]` of each action of the plan, and the states `[T - 1, D]` they lead to.

        Args:
            states: `[past + T, D]`.
            actions: `[past + T - 1]` those between them.
            deterministic: without dropout.
        """
        between = jnp.append(jnp.tanh(self.action(actions)), jnp.zeros((1, states.shape[1])), 0)
        tokens = jnp.stack([states, between], axis=1).reshape(-1, states.shape[1])[:-1]
        tokens += self.position(jnp.arange(tokens.shape[0]))
        h = self.transformer(
            self.drop(tokens, deterministic=deterministic),
            jnp.arange(2 * self.past, tokens.shape[0]),
            mask=causal_mask(tokens.shape[0]), deterministic=deterministic,
        )  # fmt: skip
        return self.choose(h[::2]), self.norm(self.predict(h[1::2]))

    def logits(
        self, memory: tuple[jax.Array, jax.Array], actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        """Logits `[P, A]` at `positions [P]`, given the actions before each: states are predicted.

        Args:
            memory: from `encode`.
            actions: `[T]`; what is not chosen yet may be MASK.
            positions: P of them.
        """
        check_plan(actions, self.sizes.horizon)
        known, before = memory
        horizon = self.sizes.horizon
        between = jnp.concatenate([before, actions[:-1]])
        unknown = jnp.zeros((horizon - 1, known.shape[1]))

        def predict(place: int | jax.Array, states: jax.Array) -> jax.Array:
            _, led = self.read(states, between)
            return states.at[self.past + 1 + place].set(led[place])

        # Only as far as is asked for: the next pass may change what comes after.
        states = jnp.concatenate([known, unknown])
        if horizon > 1:
            states = jax.lax.fori_loop(0, positions.max(), predict, states)
        chosen, _ = self.read(states, between)
        return forbid_early_end(chosen[positions], positions)
