"""Planning with sequence models through iterative energy minimisation, in JAX.

An `Energy` is a few pure functions of one trajectory; a planner finds a plan of low
energy; `compile_planner` makes it plan for any number of contexts at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from leapjax.batching import CompiledPlanner, compile_planner, plan_keys
    from leapjax.domain import Domain
    from leapjax.energy import (
        Factors,
        autoregressive,
        classifier,
        compose,
        constrain,
        from_factors,
        from_total,
        neutral,
        pseudo_likelihood,
        single_action,
        symmetric,
        view,
    )
    from leapjax.errors import UserError
    from leapjax.fitting import fit, make_domain
    from leapjax.planners import (
        BeamConfig,
        CrossEntropyConfig,
        GibbsConfig,
        ShootingConfig,
        beam_search,
        cross_entropy_method,
        gibbs,
        random_shooting,
    )
    from leapjax.pretrained import Pretrained, load
    from leapjax.pure import PureEnvironment, compile_rollout
    from leapjax.rollouts import Episodes, evaluate
    from leapjax.scores import (
        aggregate,
        interval_of_episodes,
        interval_over_seeds,
        wilson_interval,
    )
    from leapjax.types import Agent, Context, Demonstration, Energy, Plan, TrainState, Turned
    from leapjax.version import __version__ as __version__

__all__ = [
    "Agent",
    "BeamConfig",
    "CompiledPlanner",
    "Context",
    "CrossEntropyConfig",
    "Demonstration",
    "Domain",
    "Energy",
    "Episodes",
    "Factors",
    "GibbsConfig",
    "Plan",
    "Pretrained",
    "PureEnvironment",
    "ShootingConfig",
    "TrainState",
    "Turned",
    "UserError",
    "aggregate",
    "autoregressive",
    "beam_search",
    "classifier",
    "compile_planner",
    "compile_rollout",
    "compose",
    "constrain",
    "cross_entropy_method",
    "evaluate",
    "fit",
    "from_factors",
    "from_total",
    "gibbs",
    "interval_of_episodes",
    "interval_over_seeds",
    "load",
    "make_domain",
    "neutral",
    "plan_keys",
    "pseudo_likelihood",
    "random_shooting",
    "single_action",
    "symmetric",
    "view",
    "wilson_interval",
]

# Public names by module. The first use of a name imports its module.
_DEFINED = {
    "leapjax.batching": ("CompiledPlanner", "compile_planner", "plan_keys"),
    "leapjax.domain": ("Domain",),
    "leapjax.energy": (
        "Factors",
        "autoregressive",
        "classifier",
        "compose",
        "constrain",
        "from_factors",
        "from_total",
        "neutral",
        "pseudo_likelihood",
        "single_action",
        "symmetric",
        "view",
    ),
    "leapjax.errors": ("UserError",),
    "leapjax.fitting": ("fit", "make_domain"),
    "leapjax.planners": (
        "BeamConfig",
        "CrossEntropyConfig",
        "GibbsConfig",
        "ShootingConfig",
        "beam_search",
        "cross_entropy_method",
        "gibbs",
        "random_shooting",
    ),
    "leapjax.pretrained": ("Pretrained", "load"),
    "leapjax.pure": ("PureEnvironment", "compile_rollout"),
    "leapjax.rollouts": ("Episodes", "evaluate"),
    "leapjax.scores": (
        "aggregate",
        "interval_of_episodes",
        "interval_over_seeds",
        "wilson_interval",
    ),
    "leapjax.types": (
        "Agent",
        "Context",
        "Demonstration",
        "Energy",
        "Plan",
        "TrainState",
        "Turned",
    ),
    "leapjax.version": ("__version__",),
}
_PLACES = {name: module for module, names in _DEFINED.items() for name in names}

if not TYPE_CHECKING:  # `__getattr__` would hide wrong names from a type checker

    def __getattr__(name: str) -> Any:
        """Imports a public name when it is first used (PEP 562)."""
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from leapjax.extras import report_missing  # noqa: PLC0415  (rarely needed)

        with report_missing():
            value = getattr(importlib.import_module(_PLACES[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Lists all names, also public names that are not imported yet."""
    return sorted({*globals(), *_PLACES})
