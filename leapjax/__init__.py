"""Planning with sequence models through iterative energy minimisation, in JAX.

An `Energy` is a few pure functions of one trajectory; a planner finds a plan of low
energy; `compile_planner` makes it plan for any number of contexts at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

from leapjax.batching import CompiledPlanner, compile_planner, plan_keys
from leapjax.domain import Domain
from leapjax.energy import (
    autoregressive,
    classifier,
    compose,
    constrain,
    from_total,
    neutral,
    pseudo_likelihood,
    single_action,
    view,
)
from leapjax.errors import UserError
from leapjax.extras import missing_explained
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
from leapjax.pure import PureEnvironment, compile_rollout
from leapjax.rollouts import Episodes, evaluate
from leapjax.scores import interval_of_episodes, interval_over_seeds, wilson_interval
from leapjax.types import Agent, Context, Demonstration, Energy, Plan, TrainState

if TYPE_CHECKING:
    from leapjax.pretrained import Pretrained, load

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
    "GibbsConfig",
    "Plan",
    "Pretrained",
    "PureEnvironment",
    "ShootingConfig",
    "TrainState",
    "UserError",
    "autoregressive",
    "beam_search",
    "classifier",
    "compile_planner",
    "compile_rollout",
    "compose",
    "constrain",
    "cross_entropy_method",
    "evaluate",
    "from_total",
    "gibbs",
    "interval_of_episodes",
    "interval_over_seeds",
    "load",
    "neutral",
    "plan_keys",
    "pseudo_likelihood",
    "random_shooting",
    "single_action",
    "view",
    "wilson_interval",
]

# Names that need Flax and an extra, by the module that `__getattr__` imports them from.
_LATER = {
    "Pretrained": "leapjax.pretrained",
    "load": "leapjax.pretrained",
}

if not TYPE_CHECKING:  # a type checker would take every name for one that exists

    def __getattr__(name: str) -> Any:
        """Imports a name of `_LATER` when it is first used (PEP 562)."""
        if name not in _LATER:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        with missing_explained():
            value = getattr(importlib.import_module(_LATER[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Lists the names that are imported later, too."""
    return sorted({*globals(), *_LATER})
