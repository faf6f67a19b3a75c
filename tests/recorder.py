"""A planner that remembers what it was asked and what it answered."""

import jax

import leapjax as leap
from leapjax.types import Context, Plan


class Recorder:
    """Plans as another planner does."""

    def __init__(self, plan: leap.CompiledPlanner) -> None:
        self.plan = plan
        self.contexts: list[Context] = []
        self.plans: list[Plan] = []

    @property
    def num_actions(self) -> int:
        """As many as the other one's."""
        return self.plan.num_actions

    def __call__(self, params, keys, contexts) -> Plan:
        """The plans of the other one."""
        plans = self.plan(params, keys, contexts)
        self.contexts.append(contexts)
        self.plans.append(jax.device_get(plans))
        return plans
