"""The paper's sequence classifier: an LSTM over a whole plan (appendix, ablation)."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.plans import check_plan
from leapjax.models.transformer import dense, embed
from leapjax.types import Context, PyTree


class SequenceClassifier(nn.Module):
    """An LSTM that reads a whole plan and estimates how corrupted it is.

    The tokens of the context give the LSTM's initial carry.

    Attributes:
        config: size of the network; only its width is used.
        sizes: sizes of contexts and plans.
        context: encoder of the domain, with tokens `[C, D]` of a context.
    """

    config: ModelConfig
    sizes: Sizes
    context: Encoder

    def setup(self) -> None:  # noqa: D102
        c = self.config
        self.begin = dense(2 * c.width, scale=0.1)
        self.action = embed(self.sizes.num_actions, c.width)
        self.recurrence = nn.RNN(nn.OptimizedLSTMCell(c.width))
        self.head = nn.Dense(1)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens `[B, C, D]` of B contexts."""
        return self.context.encode_batch(contexts)

    def encode(self, context: Context, tokens: jax.Array | None = None) -> PyTree:
        """Returns the LSTM's initial carry, `[D]` and `[D]`.

        Args:
            context: context to plan from.
            tokens: encoder's tokens, from `encode_batch`; if `None`, the network encodes the
                context.
        """
        tokens = self.context(context) if tokens is None else tokens
        return tuple(jnp.split(self.begin(tokens.reshape(-1)), 2))

    def degree(self, memory: PyTree, actions: jax.Array) -> jax.Array:
        """Estimates the degree of corruption `[]` of a plan, from 0 (no action) to 1 (all).

        Args:
            memory: result of `encode`.
            actions: complete plan `[T]`.
        """
        check_plan(actions, self.sizes.horizon)
        states = self.recurrence(self.action(actions), initial_carry=memory)
        return self.head(states[-1])[0]
