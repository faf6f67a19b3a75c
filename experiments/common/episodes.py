"""One episode, watched: each plan before it is executed, and each step when it was taken."""

from collections.abc import Callable, Iterator

import numpy as np

from leapjax import rollouts
from leapjax.batching import plan_keys
from leapjax.environments import Adapter, Transition
from leapjax.types import Array, Context, Plan

Step = tuple[int, Transition]  # an action, and what came of it


def watched(
    adapter: Adapter,
    plan: Callable[[Array, Context], Plan],
    context: int,
    level_seed: int,
    seed: int = 0,
    executed: int | None = None,
    most: int | None = None,
) -> Iterator[Plan | Step]:
    """Plays as `leapjax.rollouts.evaluate` does, with the same plans.

    Args:
        adapter: of the level; as it is between two events it can be drawn.
        plan: (keys `[1]`, contexts `[1]`) -> plans `[1]`.
        context: K.
        level_seed: of the episode.
        seed: of the planner's randomness.
        executed: actions of each plan; None for all.
        most: plans; an episode that needs more is cut off. None: as many as it takes.
    """
    history = rollouts.History(adapter.reset(level_seed), context, adapter.num_actions, level_seed)
    replan = 0
    while most is None or replan < most:
        keys = plan_keys(seed, np.array([level_seed]), np.array([replan]))
        plans = plan(keys, rollouts.stack_contexts([history]))
        yield plans
        actions = np.asarray(plans.actions[0])[:executed]
        encoded = rollouts.kept(plans, executed)
        if actions[0] >= adapter.num_actions - 1:  # the end action: it has given up
            return
        for action in actions:
            if action >= adapter.num_actions - 1:
                break
            transition = adapter.step(int(action))
            history.advance(
                transition.executed(int(action)), transition.observation, transition.reward,
                None if encoded is None else encoded[0],
            )  # fmt: skip
            yield int(action), transition
            if transition.terminated or transition.truncated:
                return
        replan += 1
