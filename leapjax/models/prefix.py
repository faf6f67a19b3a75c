"""Our network: the tokens of a context are a cached prefix, and a pass runs over actions only."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.plans import check_plan, forbid_early_end, make_attention_mask
from leapjax.models.transformer import KeysValues, Transformer, dense, embed
from leapjax.types import Context, PyTree


class Prefix(NamedTuple):
    """The part of a pass that all plans from one context share.

    Attributes:
        known: keys and values of the context's tokens, per layer.
        positions: positions of a plan, as the encoder's `place_actions` takes them.
        groups: booleans `[G, T, T]` from the encoder's `group_positions`, or `None`.
    """

    known: list[KeysValues]
    positions: PyTree
    groups: jax.Array | None = None


class PrefixModel(nn.Module):
    """Our network: it encodes the context once per plan, and reuses its keys and values.

    The tokens of the context are a prefix that never attends to the plan. So `encode` computes its
    keys and values once per plan, and a pass runs over T action tokens only. A network that is
    conditioned on the return to go has an additional context token.

    The encoder may encode the positions of a plan (`encode_positions`); otherwise this network
    learns an embedding of each. The encoder also puts actions at their positions (`place_actions`),
    and may say which positions belong together (`group_positions`).

    Attributes:
        config: size of the network.
        sizes: sizes of contexts and plans.
        context: encoder of the domain, with a few tokens `[C, D]` of a context.
        conditioned: whether the network is conditioned on the return to go.
    """

    config: ModelConfig
    sizes: Sizes
    context: Encoder
    conditioned: bool = False

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        self.action = embed(sizes.num_actions + 2, c.width)
        if self.conditioned:
            self.goal = dense(c.width, scale=1.0)
        self.position = embed(sizes.horizon, c.width)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.head = dense(sizes.num_actions, use_bias=False)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens `[B, C, D]` of B contexts."""
        return self.context.encode_batch(contexts)

    def encode(
        self,
        context: Context,
        deterministic: bool = True,
        returns: jax.Array | None = None,
        tokens: jax.Array | None = None,
    ) -> Prefix:
        """Encodes a context and the positions of a plan, once for all passes.

        Args:
            context: context to plan from.
            deterministic: whether to leave out dropout.
            returns: returns to go `[K + 1]` at each state; `None` if not conditioned.
            tokens: encoder's tokens, from `encode_batch`; if `None`, the network encodes the
                context.
        """
        tokens = self.context(context) if tokens is None else tokens
        if returns is not None:
            tokens = jnp.concatenate([tokens, jnp.tanh(self.goal(returns[-1:, None]))])
        tokens = self.drop(tokens, deterministic=deterministic)
        known = self.transformer.prefix(tokens, deterministic=deterministic)
        positions = self.context.encode_positions(context, self.sizes.horizon)
        if positions is None:
            positions = self.position(jnp.arange(self.sizes.horizon))
        groups = self.context.group_positions(context, self.sizes.horizon)
        return Prefix(known, positions, groups)

    def logits(
        self,
        memory: Prefix,
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
        tokens = self.context.place_actions(self.action(actions), memory.positions)
        x = self.drop(tokens, deterministic=deterministic)
        cached = memory.known[0].keys.shape[0]
        mask = make_attention_mask(self.config, self.sizes.horizon, cached, memory.groups)
        h = self.transformer(x, positions, memory.known, mask, deterministic=deterministic)
        return forbid_early_end(self.head(h), positions)
