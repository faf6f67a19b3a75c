"""A planner that records its inputs and its plans."""

import jax

import leapjax as leap
from leapjax.types import Context, Plan, PyTree


class Recorder:
    """Delegates to a planner, and records the calls."""

    def __init__(self, plan: leap.CompiledPlanner) -> None:
        self.plan = plan
        self.contexts: list[Context] = []
        self.caches: list[PyTree] = []
        self.plans: list[Plan] = []

    @property
    def num_actions(self) -> int:
        return self.plan.num_actions

    def plan_next(self, params, keys, contexts, cache) -> tuple[Plan, PyTree]:
        plans, next_cache = self.plan.plan_next(params, keys, contexts, cache)
        self.contexts.append(contexts)
        self.caches.append(cache)
        self.plans.append(jax.device_get(plans))
        return plans, next_cache
