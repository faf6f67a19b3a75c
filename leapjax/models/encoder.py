"""The interface of a domain's encoder: tokens of a context, and optional abilities."""

import flax.linen as nn
import jax

from leapjax.errors import UserError
from leapjax.types import Context, PyTree


class Encoder(nn.Module):
    """Turns a context into tokens. A subclass defines `__call__`; the rest has defaults.

    An encoder for architecture `paper` makes a token for each state of the context, C = K + 1; the
    last token is the current state's. For `leapjax` C is any number.
    """

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens `[C, D]` of one context."""
        raise NotImplementedError

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the tokens `[B, C, D]` of B contexts, for training.

        An encoder overrides this if it can encode a batch faster than with `vmap`.
        """
        each = nn.vmap(
            lambda encoder, context: encoder(context),
            variable_axes={"params": None}, split_rngs={"params": False},
        )  # fmt: skip
        tokens: jax.Array = each(self, contexts)
        return tokens

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the tokens `[C, D]` of a context, given the tokens of its past states.

        An encoder with a token for each state overrides this, to encode the new state only.

        Args:
            context: current context, K > 0.
            known: tokens `[K, D]` of its past states, from the previous plan; `None` when an
                episode begins.
        """
        del known
        return self(context)

    def encode_positions(self, context: Context, horizon: int) -> PyTree | None:
        """Returns the positions of a plan as `place_actions` needs them; computed once per plan.

        By default it returns `None`, and the network learns an embedding `[T, D]` of the positions.
        """
        del context, horizon
        return None

    def for_plans(self, horizon: int) -> "Encoder":
        """Returns this encoder for a network that calls `encode_positions` for T actions.

        Its context may leave out what the positions show. By default it returns itself.
        """
        del horizon
        return self

    def group_positions(self, context: Context, horizon: int) -> jax.Array | None:
        """Returns which positions of a plan belong together: booleans `[G, T, T]`.

        A head of the network's attention then sees one of the G kinds of groups; every further head
        sees all positions. By default it returns `None`, and all heads see all positions.
        """
        del context, horizon
        return None

    def place_actions(self, tokens: jax.Array, positions: PyTree) -> jax.Array:
        """Returns the tokens `[T, D]` of a plan's actions at their positions; by default the sum.

        An encoder overrides this if an action means little without related actions.

        Args:
            tokens: tokens `[T, D]` of the actions alone.
            positions: result of `encode_positions`, or the learned embedding `[T, D]`.
        """
        placed: jax.Array = tokens + positions
        return placed

    def add_later_state(self) -> "Encoder":
        """Returns this encoder with an additional token for later states, whose pose is unknown.

        Raises:
            UserError: the encoder does not separate the pose from the rest of a state.
        """
        raise UserError(
            "states that are not repeated are for architecture 'paper' on BabyAI: no other encoder "
            "says what a state with an unknown pose looks like; repeat states elsewhere",
            "repeat_state",
        )
