"""Planners: `(energy, params, key, memory, config) -> Plan`, pure, for one context.

They know only `Energy`; `memory` is the result of its `encode` for the context. `leapjax.batching`
compiles a planner for any number of contexts.
"""

from collections.abc import Callable

import jax

from leapjax.checks import check_kind
from leapjax.planners.beams import beam_search
from leapjax.planners.candidates import cross_entropy_method, random_shooting
from leapjax.planners.configs import (
    FILLS,
    ORDERS,
    BeamConfig,
    CrossEntropyConfig,
    GibbsConfig,
    PlannerConfig,
    ShootingConfig,
)
from leapjax.planners.gibbs import gibbs
from leapjax.types import Energy, Params, Plan, PyTree

__all__ = [
    "FILLS", "ORDERS", "BeamConfig", "CrossEntropyConfig", "GibbsConfig", "PlannerConfig",
    "ShootingConfig", "beam_search", "bind", "cross_entropy_method", "find_planner", "gibbs",
    "random_shooting",
]  # fmt: skip


def find_planner(config: PlannerConfig) -> Callable[..., Plan]:
    """Returns the planner that takes a configuration: `gibbs`, `beam_search` and so on.

    Raises:
        TypeError: no planner takes such a configuration.
    """
    planners: dict[type, Callable[..., Plan]] = {
        GibbsConfig: gibbs,
        ShootingConfig: random_shooting,
        CrossEntropyConfig: cross_entropy_method,
        BeamConfig: beam_search,
    }
    if type(config) not in planners:
        known = ", ".join(kind.__name__ for kind in planners)
        raise TypeError(f"no planner takes a {type(config).__name__}: expected one of {known}")
    return planners[type(config)]


def bind(energy: Energy, config: PlannerConfig) -> Callable[[Params, jax.Array, PyTree], Plan]:
    """Returns `(params, key, context) -> Plan`, which encodes the context and plans.

    Raises:
        UserError: the energy is no `Energy`.
        TypeError: no planner takes such a configuration.
    """
    check_kind(energy, Energy)
    planner = find_planner(config)

    def plan(params: Params, key: jax.Array, context: PyTree) -> Plan:
        return planner(energy, params, key, energy.encode(params, context), config)

    return plan
