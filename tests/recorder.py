"""A planner that remembers what it was asked and what it answered."""

import jax

import leapjax as leap
from leapjax.types import Context, Plan, PyTree


class Recorder:
    """Plans as another planner does."""

    def __init__(self, plan: leap.CompiledPlanner) -> None:
        self.plan = plan
        self.contexts: list[Context] = []
        self.caches: list[PyTree] = []
        self.plans: list[Plan] = []

    @property
    def num_actions(self) -> int:
        """As many as the other one's."""
        return self.plan.num_actions

    def plan_next(self, params, keys, contexts, cache) -> tuple[Plan, PyTree]:
        """The plans of the other one."""
        plans, after = self.plan.plan_next(params, keys, contexts, cache)
        self.contexts.append(contexts)
        self.caches.append(cache)
        self.plans.append(jax.device_get(plans))
        return plans, after
