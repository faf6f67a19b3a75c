"""With default settings, methods imitate an expert as well as behaviour cloning does."""

import functools

import gymnasium as gym
import numpy as np
import pytest

import leapjax as leap
from tests.episodes import SMALL, record_episode
from tests.programs import only_long

LAKE, POLE = "FrozenLake8x8-v1", "CartPole-v1"
EPISODES = 200
# QR-DQN and REM are left out: an expert shows a single action per state, and their losses do not
# lower other values. On ice they reach 41 and 24% with the default network, cloning 84%.
METHODS = ("bcq", "cql", "dt", "iql", "mopo", "plate")
# A small network learns a single action of the pole better than plans of five.
CASES = [
    *((level, method, SMALL) for level in (LAKE, POLE) for method in METHODS),
    (LAKE, "leap", SMALL),
    (POLE, "leap", None),  # the default network
]


def solve_lake(transitions):
    """Finds the best action in each state of slippery ice, from FrozenLake's `transitions`."""
    value = np.zeros(len(transitions))
    for _ in range(1000):
        q = np.array(
            [
                [sum(p * (r + 0.99 * (not over) * value[after]) for p, after, r, over in outcomes)
                 for outcomes in actions.values()]
                for actions in transitions.values()
            ]
        )  # fmt: skip
        value = q.max(axis=1)
    return q.argmax(axis=1)


@functools.cache
def record_expert(level):
    env = gym.make(level)
    if level == POLE:
        weights = np.array([0.02, 0.1, 1.0, 0.5])
        return [record_episode(env, lambda state: int(state @ weights > 0), i) for i in range(30)]
    best = solve_lake(env.unwrapped.P)
    return [record_episode(env, lambda state: int(best[state]), i) for i in range(300)]


@functools.cache
def measure_success(level, method, model):
    """Returns a method's success rate after training on the expert."""
    domain = leap.make_domain("gymnasium", level)
    planner = leap.fit(record_expert(level), domain, method, model=model)
    context, seeds = planner.specification.context, range(10_000, 10_000 + EPISODES)
    adapter, plan = planner.domain.make_adapter, planner.plan
    episodes = leap.evaluate(adapter, seeds, plan, planner.params, context=context, executed=1)
    return episodes.successes.mean()


@only_long
@pytest.mark.parametrize(("level", "method", "model"), CASES)
def test_methods_imitate_an_expert_as_well_as_cloning(level, method, model):
    """The tolerance is two standard errors of the difference."""
    cloning, success = measure_success(level, "bc", model), measure_success(level, method, model)
    error = np.sqrt(sum(rate * (1 - rate) / EPISODES for rate in (cloning, success)))
    assert success >= cloning - 2 * error
    if level == POLE:
        assert cloning > 0.8
    else:
        expert = np.mean([each.rewards[-1] for each in record_expert(level)])
        assert cloning == pytest.approx(expert, abs=0.1)
