"""Returns to go, on which Decision Transformer and LEAP can be conditioned (Chen et al., 2021)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.agents.base import Setup
from leapjax.checks import check_types
from leapjax.errors import UserError
from leapjax.types import Context, Demonstration

QUANTILE = 0.99  # of the demonstrations' returns: the target where settings name none

ComputeReturns = Callable[..., jax.Array | None]
# (context, return to go at a demonstration's current state) -> returns to go [K + 1] for the
# network, or `None` if it has no such input. While acting, the second argument is `None`.


@dataclasses.dataclass(frozen=True)
class ReturnSettings:
    """The options of every method that can be conditioned on returns.

    Attributes:
        target_return: Return of an episode to aim for while acting; `None` for a high return of the
            training data.
        return_scale: Divisor of returns, besides that of the domain, because the network's input
            saturates; `None` takes the largest return to go of the data, in absolute value.
    """

    target_return: float | None = 1.0
    return_scale: float | None = 1.0

    def __post_init__(self) -> None:
        check_types(self)
        if self.return_scale is not None and self.return_scale <= 0:
            raise ValueError(
                f"return_scale must be positive, got {self.return_scale}: it divides returns"
            )

    @property
    def conditioned(self) -> bool:
        """Whether the network reads returns to go."""
        return True


def aims_for_return(settings: Any) -> bool:
    """Returns whether a method with these settings is conditioned on returns."""
    return isinstance(settings, ReturnSettings) and settings.conditioned


def lacks_target(settings: Any) -> bool:
    """Returns whether a method with these settings takes its target return from the data."""
    return aims_for_return(settings) and settings.target_return is None


def lacks_return_scale(settings: Any) -> bool:
    """Returns whether a method with these settings takes its scale of returns from the data."""
    return aims_for_return(settings) and settings.return_scale is None


def sum_rewards(demonstrations: Sequence[Demonstration]) -> list[float]:
    """Returns the return of each demonstration."""
    return [float(np.sum(each.rewards, dtype=np.float64)) for each in demonstrations]


def choose_target(demonstrations: Sequence[Demonstration]) -> float:
    """Returns a high return of the data, at their `QUANTILE`: a good episode's, not the luckiest's.

    Args:
        demonstrations: training data, at least one.
    """
    return float(np.quantile(sum_rewards(demonstrations), QUANTILE, method="lower"))


def condition_on_target(setup: Setup) -> ComputeReturns:
    """Makes a function that computes the returns to go at the past states and the current one.

    While acting, the current return to go is the target return minus the return so far. The
    function divides all returns by `Domain.scaling.returns` and by `return_scale`.
    """

    def compute(context: Context, return_to_go: jax.Array | None = None) -> jax.Array:
        if return_to_go is None:
            if setup.settings.target_return is None:
                raise UserError(
                    "there is no target return, and no demonstrations to take it from",
                    "target_return",
                )
            return_to_go = setup.settings.target_return - context.return_so_far
        if setup.settings.return_scale is None:
            raise UserError(
                "there is no scale of returns, and no demonstrations to take it from",
                "return_scale",
            )
        scale = setup.domain.scaling.returns * setup.settings.return_scale
        return compute_returns_to_go(context, return_to_go) / scale

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
