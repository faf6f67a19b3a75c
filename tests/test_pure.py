"""Rollouts inside `jit` play the same episodes as the lockstep rollout."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from leapjax.environments import Transition
from leapjax.errors import UserError
from leapjax.pure import PureEnvironment, compile_rollout
from tests.programs import only_long

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
    action = jnp.where(state.steps % 3 == 2, STAY, action)  # contexts hold the action taken
    state = Place(state.at + jnp.array([-1, 1, 0])[action], state.to, state.steps + 1)
    reached = state.at == state.to
    reward = jnp.where(reached, 1.0, -0.1)
    observation = {"at": state.at, "to": state.to}
    over = state.steps >= LONGEST
    near = jnp.abs(state.at - state.to) <= 1  # a success even if the planner gives up there
    # The score differs from the reward, which planners see.
    return state, Transition(observation, reward, reached, over, near, 3 * reward + 1, action)


WALK = PureEnvironment(reset, step, END + 1)


class WalkAdapter:
    num_actions = END + 1

    def reset(self, seed):
        self.state, observation = reset(jax.random.key(seed))
        return jax.device_get(observation)

    def step(self, action):
        self.state, found = step(self.state, jnp.int32(action))
        return jax.device_get(found)


def compute_energy(params, context, actions):  # reads every field of the context
    moves = jnp.array([-1, 1, 0, 0])[actions]
    distance = jnp.abs(context.observation["at"] + moves.sum() - context.observation["to"])
    visited = (context.past["at"] == context.observation["at"] + moves[0]).sum()
    habit = (context.actions == actions[0]).sum() + context.rewards.sum() + context.return_so_far
    return params * distance + 0.3 * visited + 0.1 * habit * actions[0] + 0.01 * (context.step % 3)


ENERGY = leap.from_total(lambda params, context: context, compute_energy, END + 1)
CONFIG = leap.GibbsConfig(horizon=4, iterations=6, temperature=0.7)


@pytest.mark.parametrize(
    ("context", "executed", "limit"), [(3, 2, 50), pytest.param(0, None, 5, marks=only_long)]
)
def test_episodes_equal_the_lockstep_rollout(context, executed, limit):
    seeds = range(100, 140)
    options = {"context": context, "executed": executed, "max_steps": limit}
    found = compile_rollout(WALK, ENERGY, CONFIG, **options)(1.0, seeds, 5)
    planner = leap.compile_planner(ENERGY, CONFIG, (8,))
    expected = leap.evaluate(WalkAdapter, seeds, planner, jnp.float32(1.0), seed=5, **options)
    for name in ("seeds", "successes", "lengths"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    np.testing.assert_allclose(found.returns, expected.returns, atol=1e-5)
    assert found.plans == expected.plans and found.passes == expected.passes > found.plans
    assert 0 < found.successes.sum() < len(seeds)
    assert len(set(found.lengths)) > 2 and 0 in found.lengths  # some episodes are given up


def play(params=1.0, seeds=(0, 1, 2), seed=0, world=WALK, energy=ENERGY, config=CONFIG, **options):
    options = {"context": 1, "max_steps": 9, **options}
    return compile_rollout(world, energy, config, **options)(params, seeds, seed)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"world": WALK._replace(num_actions=3)}, "energy has 4 actions and the environment 3"),
        ({"executed": 0}, "executed must be"),
        ({"max_steps": 2**31}, "max_steps must be"),
        ({"context": 1.5}, "context must be"),
        ({"params": jnp.nan}, "NaN or -inf in 3 of 3 episodes"),
        ({"params": np.float64(1e300)}, "params holds 1e[+]300"),
        ({"seeds": [0, 2**32 + 5]}, "level seed must be"),
        ({"seed": -1}, "^seed must be"),
    ],
)
def test_invalid_arguments_raise_an_error(wrong, message):
    with pytest.raises(ValueError, match=message):
        play(**wrong)


def alter(state=lambda state: state, **changes):
    """Returns the world with altered results of `step`."""

    def changed(before, action):
        after, found = step(before, action)
        parts = {name: change(getattr(found, name)) for name, change in changes.items()}
        return state(after), found._replace(**parts)

    return WALK._replace(step=changed)


def triple(tree):
    return jax.tree.map(lambda x: jnp.stack([x] * 3), tree)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (alter(observation=triple), r"observation\['at'\] as int32\[3\], but reset as int32\[\]"),
        (alter(state=lambda s: s._replace(at=triple(s.at))), "state.at"),
        (WALK._replace(step=lambda s, a: step(s, a)[1]), r"must return \(state, Transition\)"),
        (WALK._replace(reset=lambda key: reset(key)[1]["at"]), r"return \(state, observation\)"),
        (
            alter(reward=lambda x: x[None]),
            r"a real number of shape \(\) as reward, got float32\[1\]",
        ),
        (alter(taken=lambda x: 1.0), "an integer .* as taken"),
    ],
)
def test_step_and_reset_must_return_matching_structures(world, message):
    with pytest.raises(UserError, match=message):
        play(world=world)


def test_non_finite_rewards_raise_an_error():
    def step_to_nan(state, action):
        state, found = step(state, action)
        return state, found._replace(reward=jnp.where(state.steps == 3, jnp.nan, 0.0))

    still = leap.from_total(lambda *_: (), lambda p, m, a: (a != STAY).sum() * 1.0, END + 1)
    world = WALK._replace(step=step_to_nan)
    rollout = compile_rollout(world, still, leap.GibbsConfig(2, 2), context=1, max_steps=5)
    assert rollout((), [8, 13]).lengths.tolist() == [2, 2]  # over before step 3
    with pytest.raises(UserError, match="not finite .* in 2 of 4 .* at step 3 of level seed 11"):
        rollout((), [8, 11, 13, 12])


@pytest.mark.parametrize("taken", [-1, END])
def test_actions_taken_out_of_range_raise_an_error(taken):
    world = alter(taken=lambda _: jnp.int32(taken))
    with pytest.raises(UserError, match=rf"`taken` outside of 0 \.\. {END - 1}\) in 3 of 3"):
        play(world=world)
