"""Rules of plans that all networks over several actions share."""

import jax
import jax.numpy as jnp

from leapjax.errors import UserError
from leapjax.models.config import ModelConfig
from leapjax.models.transformer import causal_mask


def check_plan(actions: jax.Array, horizon: int) -> None:
    """Checks that a plan has the length that a network was made for.

    Raises:
        ValueError: the shape is not `[horizon]`.
    """
    if actions.shape != (horizon,):
        raise ValueError(f"a plan of shape {actions.shape}: this network was made for ({horizon},)")


def forbid_early_end(logits: jax.Array, positions: jax.Array) -> jax.Array:
    """Sets the logit of the end action, the last one, to -inf at position 0.

    Args:
        logits: logits `[P, A]` at the positions.
        positions: positions `[P]` in a plan.
    """
    end = jnp.arange(logits.shape[-1]) == logits.shape[-1] - 1
    return jnp.where(end & (positions[:, None] == 0), -jnp.inf, logits)


def make_attention_mask(
    config: ModelConfig, tokens: int, prefix: int = 0, groups: jax.Array | None = None
) -> jax.Array | None:
    """Makes the mask `[tokens, prefix + tokens]` of a plan's tokens; `None` for full attention.

    With groups the mask is `[heads, tokens, prefix + tokens]`. The heads take the G kinds of groups
    and the whole plan in turn. All of them see the context.

    Args:
        config: configuration that names the attention.
        tokens: number of tokens of the plan.
        prefix: number of cached tokens of the context.
        groups: booleans `[G, tokens, tokens]`: which tokens belong together; `None` without groups.

    Raises:
        UserError: there are too few heads for the groups and the whole plan.
    """
    mask = causal_mask(tokens, prefix) if config.attention == "causal" else None
    if groups is None:
        return mask
    kinds = groups.shape[0] + 1
    if config.heads < kinds:
        raise UserError(
            f"{config.heads} heads: positions belong together in {kinds - 1} ways, and one more "
            f"head sees the whole plan; use at least {kinds} heads",
            "heads",
        )
    whole = jnp.ones((1, tokens, tokens), bool)
    seen = jnp.concatenate([groups, whole])[jnp.arange(config.heads) % kinds]
    seen = jnp.concatenate([jnp.ones((config.heads, tokens, prefix), bool), seen], axis=2)
    return seen if mask is None else seen & mask
