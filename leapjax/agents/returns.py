"""Returns to go, which Decision Transformer and LEAP can be asked for (Chen et al., 2021)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from leapjax.agents.learning import Setup
from leapjax.types import Context

Returns = Callable[..., jax.Array | None]
# (context, what a demonstration gave from its state on, or nothing while acting) -> [K + 1]; or
# None, for a network that is not conditioned on them


def wanted(setup: Setup) -> Returns:
    """What a network is conditioned on: at the past states and the current one.

    While acting it is the target return, less what the episode has given so far.
    """

    def returns(context: Context, return_to_go: jax.Array | None = None) -> jax.Array:
        if return_to_go is None:
            return_to_go = setup.settings.target_return - context.return_so_far
        return returns_to_go(context, return_to_go) / setup.domain.scaling.returns

    return returns


def nothing_wanted(context: Context, return_to_go: jax.Array | None = None) -> None:
    """Of a network that is not conditioned on returns."""
    del context, return_to_go


def returns_to_go(context: Context, now: jax.Array) -> jax.Array:
    """`[K + 1]`: what was to come at the past states and the current one, given `now []`."""
    later = jnp.cumsum(context.rewards[::-1])[::-1]
    return now + jnp.append(later, 0.0)
