"""Plays one episode and yields its events: each plan before execution, each step after it."""

from collections.abc import Iterator

import numpy as np

from leapjax import rollouts
from leapjax.batching import plan_keys
from leapjax.environments import Adapter, Transition
from leapjax.pretrained import Pretrained
from leapjax.types import Plan

Step = tuple[int, Transition]  # an action and its transition


def watch_episode(
    adapter: Adapter,
    planner: Pretrained,
    context: int,
    level_seed: int,
    seed: int = 0,
    executed: int | None = None,
    most: int | None = None,
) -> Iterator[Plan | Step]:
    """Plays as `leapjax.rollouts.evaluate` does, with the same plans.

    Args:
        adapter: adapter of the level, which a caller may draw after each event.
        planner: planner.
        context: K, past steps that the planner sees.
        level_seed: seed of the level.
        seed: seed of the planner's randomness.
        executed: executed actions of each plan; `None` for all.
        most: largest number of plans, after which the episode is cut off; `None` for no limit.
    """
    history = rollouts.History(adapter.reset(level_seed), context, adapter.num_actions, level_seed)
    replan, caches = 0, [None]
    while most is None or replan < most:
        keys = plan_keys(seed, np.array([level_seed]), np.array([replan]))
        plans, caches = rollouts.plan_episodes(
            planner.plan, planner.params, keys, [history], caches, executed
        )
        yield plans
        actions = np.asarray(plans.actions[0])[:executed]
        if actions[0] >= adapter.num_actions - 1:  # end comes first: the planner gives up
            return
        for action in actions:
            if action >= adapter.num_actions - 1:
                break
            transition = adapter.step(int(action))
            taken = transition.executed(int(action))
            history.advance(taken, transition.observation, transition.reward)
            yield int(action), transition
            if transition.terminated or transition.truncated:
                return
        replan += 1
