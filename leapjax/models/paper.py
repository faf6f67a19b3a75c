"""The paper's network: state and action tokens in turn, in one transformer."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.plans import check_plan, forbid_early_end, make_attention_mask
from leapjax.models.transformer import KeysValues, Transformer, causal_mask, dense, embed
from leapjax.types import Context


class Memory(NamedTuple):
    """The part of a pass that all plans from one context share.

    Attributes:
        prefix: keys and values of the context's tokens, per layer; `None` if `tokens` holds all.
        tokens: embeddings `[tokens, D]` of all other tokens; a pass adds the plan's actions.
    """

    prefix: list[KeysValues] | None
    tokens: jax.Array


class PaperModel(nn.Module):
    """The network of the paper's appendix: state and action tokens, interleaved.

    The tokens are s_1 a_1 ... s_n a_n s_n a_n+1 ... Attention is bidirectional, or causal (the
    paper's choice in Atari). A state token predicts the action that follows it. All tokens share
    an embedding of the time at the end of the plan, as in the authors' code. A network that is
    conditioned on returns to go has a return token before each state token.

    With causal attention no token of the context depends on the plan. Then `encode` computes their
    keys and values once, and a pass runs over the plan's tokens only.

    Attributes:
        config: size of the network.
        sizes: sizes of contexts and plans.
        states: encoder of the domain, with a token for each state of a context, `[K + 1, D]`. The
            last token is repeated at all positions of a plan (equation 3). An encoder may add a
            token, which then replaces the last one at all positions but the first.
        conditioned: whether the network is conditioned on returns to go.
    """

    config: ModelConfig
    sizes: Sizes
    states: Encoder
    conditioned: bool = False

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        nn.share_scope(self, self.states)  # its parameters lie beside the others
        self.action = embed(sizes.num_actions + 2, c.width)
        self.each = 3 if self.conditioned else 2  # tokens of a step
        tokens = self.each * (sizes.context + sizes.horizon)
        self.position = nn.Embed(tokens, c.width, embedding_init=nn.initializers.zeros)
        steps = sizes.max_steps + sizes.horizon + 1
        self.time = nn.Embed(steps, c.width, embedding_init=nn.initializers.zeros)
        if self.conditioned:
            self.goal = dense(c.width, scale=1.0)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.head = dense(sizes.num_actions, use_bias=False)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens of B contexts: `[B, K + 1, D]` or `[B, K + 2, D]`."""
        return self.states.encode_batch(contexts)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the encoder's tokens of a context, given the tokens of its past states."""
        return self.states.encode_next(context, known)

    def encode(
        self,
        context: Context,
        deterministic: bool = True,
        returns: jax.Array | None = None,
        tokens: jax.Array | None = None,
    ) -> Memory:
        """Encodes a context and the states of a plan, once for all passes.

        With causal attention and a past, the memory holds the context's keys and values, and
        embeddings of the plan's tokens: `[2 T, D]`, or `[3 T, D]` with returns. Otherwise it holds
        embeddings of all tokens, `[2 (K + T), D]` or `[3 (K + T), D]`.

        Args:
            context: context to plan from.
            deterministic: whether to leave out dropout.
            returns: returns to go `[K + 1]` at each state; `None` if not conditioned.
            tokens: encoder's tokens, from `encode_batch` or `encode_next`; if `None`, the network
                encodes the context.
        """
        horizon = self.sizes.horizon
        encoded = self.states(context) if tokens is None else tokens
        states, later = encoded[: self.sizes.context + 1], encoded[-1]

        def append_plan(past: jax.Array, ahead: jax.Array) -> jax.Array:
            return jnp.concatenate([past, jnp.repeat(ahead[None], horizon - 1, axis=0)])

        actions = jnp.tanh(self.action(context.actions))
        actions = jnp.concatenate([actions, jnp.zeros((horizon, self.config.width))])
        steps = [append_plan(states, later), actions]  # of [K + T, D]
        if returns is not None:
            goals = jnp.tanh(self.goal(returns[:, None]))
            steps.insert(0, append_plan(goals, goals[-1]))
        tokens = jnp.stack(steps, axis=1).reshape(-1, self.config.width)
        time = self.time(jnp.minimum(context.step, self.sizes.max_steps) + horizon)
        tokens = tokens + self.position(jnp.arange(tokens.shape[0])) + time
        if self.config.attention != "causal" or self.sizes.context == 0:
            return Memory(None, tokens)
        past, planned = jnp.split(tokens, [self.each * self.sizes.context])
        past = self.drop(past, deterministic=deterministic)
        mask = causal_mask(past.shape[0])
        return Memory(self.transformer.prefix(past, mask, deterministic), planned)

    def logits(
        self,
        memory: Memory,
        actions: jax.Array,
        positions: jax.Array,
        deterministic: bool = True,
    ) -> jax.Array:
        """Returns logits `[P, A]` at some positions of a plan.

        Args:
            memory: result of `encode`.
            actions: plan `[T]`, which may hold MASK.
            positions: positions `[P]`.
            deterministic: whether to leave out dropout.
        """
        check_plan(actions, self.sizes.horizon)
        prefix, tokens = memory
        past = tokens.shape[0] - self.each * self.sizes.horizon  # number of the context's tokens
        states = past + self.each * jnp.arange(self.sizes.horizon) + self.each - 2
        x = tokens.at[states + 1].add(jnp.tanh(self.action(actions)))
        x = self.drop(x, deterministic=deterministic)
        cached = 0 if prefix is None else len(prefix[0].keys)
        mask = make_attention_mask(self.config, x.shape[0], cached)
        h = self.transformer(x, states[positions], prefix, mask, deterministic)
        return forbid_early_end(self.head(h), positions)
