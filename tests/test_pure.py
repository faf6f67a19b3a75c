"""Episodes inside `jit` are the episodes of the lockstep rollout."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from leapjax.environments import Transition
from leapjax.pure import PureEnvironment, compile_rollout

LEFT, RIGHT, STAY, END = range(4)
LONGEST = 12


class Place(NamedTuple):
    at: jax.Array
    to: jax.Array
    steps: jax.Array


def reset(key):
    here, there = jax.random.randint(key, (2,), -6, 7)
    state = Place(here, there, jnp.int32(0))
    return state, {"at": state.at, "to": state.to}


def step(state, action):
    state = Place(state.at + jnp.array([-1, 1, 0])[action], state.to, state.steps + 1)
    reached = state.at == state.to
    reward = jnp.where(reached, 1.0, -0.1)
    observation = {"at": state.at, "to": state.to}
    return state, Transition(observation, reward, reached, state.steps >= LONGEST, reached)


WALK = PureEnvironment(reset, step, END + 1)


class Adapter:
    """The same world, step by step."""

    num_actions = END + 1

    def reset(self, seed):
        self.state, observation = reset(jax.random.key(seed))
        return jax.device_get(observation)

    def step(self, action):
        self.state, found = step(self.state, jnp.int32(action))
        found = jax.device_get(found)
        return Transition(
            found.observation, float(found.reward), bool(found.terminated),
            bool(found.truncated), bool(found.success),
        )  # fmt: skip


def total(params, context, actions):
    """Go there; rather not where one has been; all of the context matters."""
    moves = jnp.array([-1, 1, 0, 0])[actions]
    miss = jnp.abs(context.observation["at"] + moves.sum() - context.observation["to"])
    been = (context.past["at"] == context.observation["at"] + moves[0]).sum()
    habit = (context.actions == actions[0]).sum() + context.rewards.sum() + context.return_so_far
    return params * miss + 0.3 * been + 0.1 * habit * actions[0] + 0.01 * (context.step % 3)


ENERGY = leap.from_total(lambda params, context: context, total, END + 1)
CONFIG = leap.GibbsConfig(horizon=4, iterations=6, temperature=0.7)


@pytest.mark.parametrize(("context", "executed", "most"), [(0, None, 50), (3, 2, 50), (1, 3, 5)])
def test_the_episodes_are_those_of_the_lockstep_rollout(context, executed, most):
    seeds = range(100, 140)
    rollout = compile_rollout(
        WALK, ENERGY, CONFIG, context=context, executed=executed, max_steps=most
    )
    found = rollout(1.0, seeds, 5)
    expected = leap.evaluate(
        Adapter, seeds, leap.compile_planner(ENERGY, CONFIG, (8,)), jnp.float32(1.0),
        context=context, seed=5, executed=executed, max_steps=most,
    )  # fmt: skip
    for name in ("seeds", "successes", "lengths"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    np.testing.assert_allclose(found.returns, expected.returns, atol=1e-5)
    assert found.plans == expected.plans
    assert 0 < found.successes.sum() < len(seeds)
    assert len(set(found.lengths)) > 2


def test_scores_are_reported_where_they_are_not_the_rewards():
    def scored(state, action):
        state, found = step(state, action)
        return state, found._replace(score=10.0)

    plain, other = (
        compile_rollout(world, ENERGY, CONFIG, context=1, max_steps=9)(1.0, range(8))
        for world in (WALK, WALK._replace(step=scored))
    )
    np.testing.assert_array_equal(other.lengths, plain.lengths)  # planners saw the rewards
    np.testing.assert_allclose(other.returns, 10 * other.lengths)
    assert (plain.returns != other.returns).any()


def test_a_plan_that_ends_at_once_gives_up():
    lazy = leap.from_total(
        lambda params, context: context, lambda p, c, a: (a != END).sum(), END + 1
    )
    rollout = compile_rollout(WALK, lazy, leap.GibbsConfig(2, 20), context=0, max_steps=9)
    found = rollout((), range(5))
    assert not found.lengths.any() and not found.successes.any() and found.plans == 5


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="the energy has 4 actions and the environment 3"):
        compile_rollout(WALK._replace(num_actions=3), ENERGY, CONFIG, context=0, max_steps=9)
    for name in ("executed", "max_steps"):
        options = {"max_steps": 9, name: 0}
        with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
            compile_rollout(WALK, ENERGY, CONFIG, context=0, **options)
    rollout = compile_rollout(WALK, ENERGY, CONFIG, context=0, max_steps=9)
    with pytest.raises(ValueError, match="NaN or -inf in 3 of 3 episodes"):
        rollout(jnp.nan, range(3))
