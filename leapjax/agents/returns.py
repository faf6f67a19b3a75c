"""Returns to go, on which Decision Transformer and LEAP can be conditioned (Chen et al., 2021)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from leapjax.agents.base import Setup
from leapjax.types import Context

ComputeReturns = Callable[..., jax.Array | None]
# (context, return to go at a demonstration's current state) -> returns to go [K + 1] for the
# network, or `None` if it has no such input. While acting, the second argument is `None`.


def condition_on_target(setup: Setup) -> ComputeReturns:
    """Makes a function that computes the returns to go at the past states and the current one.

    While acting, the current return to go is the target return minus the return so far. The
    function divides all returns by `Domain.scaling.returns`.
    """

    def compute(context: Context, return_to_go: jax.Array | None = None) -> jax.Array:
        if return_to_go is None:
            return_to_go = setup.settings.target_return - context.return_so_far
        return compute_returns_to_go(context, return_to_go) / setup.domain.scaling.returns

    return compute


def omit_returns(context: Context, return_to_go: jax.Array | None = None) -> None:
    """Returns `None`, for a network that is not conditioned on returns."""
    del context, return_to_go


def compute_returns_to_go(context: Context, current: jax.Array) -> jax.Array:
    """Returns the returns to go `[K + 1]` at the past states and the current one.

    Args:
        context: holds the rewards `[K]` of the past steps.
        current: return to go `[]` at the current state.
    """
    later = jnp.cumsum(context.rewards[::-1])[::-1]
    return current + jnp.append(later, 0.0)
