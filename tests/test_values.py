"""With the default settings of an environment, methods learn exact values."""

import functools
import itertools
import warnings

import gymnasium as gym
import jax
import numpy as np
import pytest

import leapjax as leap
from leapjax import fitting
from leapjax.agents import value_range
from leapjax.domain import blank_context
from leapjax.types import Demonstration
from tests.episodes import SMALL, record_episode
from tests.parameters import make_begin
from tests.programs import only_long
from tests.quick import quick_jit

STATES, SLIP, DISCOUNT = 24, 0.2, 0.99


class Corridor(gym.Env):
    """Action 1 steps forward to the goal, but a fifth of the steps go the other way."""

    observation_space = gym.spaces.Discrete(STATES)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return 0, {}

    def step(self, action):
        forward = bool(action) != (self.np_random.random() < SLIP)
        self.place = max(self.place + (1 if forward else -1), 0)
        over = self.place == STATES
        return min(self.place, STATES - 1), float(over), over, False, {}


@pytest.fixture(autouse=True, scope="module")
def register_corridor():
    gym.register("SlipperyCorridor-v0", Corridor, max_episode_steps=150)
    yield
    del gym.registry["SlipperyCorridor-v0"]


def walk(env, seed, rng):
    """Records an episode of a policy that steps forward with a probability of 40 to 90%."""
    share = rng.uniform(0.4, 0.9)
    return record_episode(env, lambda seen: int(rng.random() < share), seed)


def iterate_values(read_value):
    """Computes exact Q-values [STATES, 2]; `read_value` maps Q-values to state values [STATES]."""
    q = np.zeros((STATES, 2))
    for _ in range(3000):
        value = DISCOUNT * read_value(q)
        back, forward = np.append(value[0], value[:-1]), np.append(value[1:], 1.0)
        q = np.stack(
            [SLIP * forward + (1 - SLIP) * back, (1 - SLIP) * forward + SLIP * back], axis=1
        )
    return q


def find_expectiles(q, actions, share):
    """Computes the expectile of each state's two Q-values, for shares [STATES, 2] of actions."""
    high = share * np.take_along_axis(actions, q.argmax(1)[:, None], 1)[:, 0]
    low = (1 - share) * np.take_along_axis(actions, q.argmin(1)[:, None], 1)[:, 0]
    return (high * q.max(1) + low * q.min(1)) / (high + low)


@only_long
@pytest.mark.parametrize("method", ["bcq", "iql", "qr_dqn", "rem"])
def test_default_settings_learn_exact_values(method):
    """Methods also find the best action in each state, which demonstrations do not always take.

    CQL is left out, because its conservative term raises the values of the data's actions. MOPO is
    left out, because its values do not converge in so few steps.
    """
    domain, rng = leap.make_domain("gymnasium", "SlipperyCorridor-v0"), np.random.default_rng(0)
    env, learned = domain.make_adapter().env, []
    data = [walk(env, seed, rng) for seed in range(500)]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # for values that rewards do not allow
        planner = leap.fit(
            data, domain, method, model=SMALL,
            progress=lambda _, means: learned.append(means["value"]),
        )  # fmt: skip
    states = np.concatenate([each.observations[:-1] for each in data])
    actions = np.concatenate([each.actions for each in data])
    taken = np.stack([np.bincount(states[actions == a], minlength=STATES) for a in (0, 1)], axis=1)
    if method == "iql":
        shares = taken / taken.sum(axis=1, keepdims=True)
        share = planner.specification.method_settings.expectile
        read = functools.partial(find_expectiles, actions=shares, share=share)
        exact = read(iterate_values(read))[states].mean()
    else:
        exact = iterate_values(lambda q: q.max(1))[states, actions].mean()
    assert np.mean(learned[-3:]) == pytest.approx(exact, abs=0.1)
    assert max(learned) < 1.1  # no return exceeds 1

    blank = blank_context(planner.domain, planner.specification.context)
    contexts = jax.tree.map(lambda leaf: np.stack([leaf] * STATES), blank)
    contexts = contexts._replace(observation=np.arange(STATES))
    memory = quick_jit(jax.vmap(planner.energy.encode, (None, 0)))(planner.params, contexts)
    first = np.zeros((STATES, 1), np.int32)
    conditional = jax.vmap(planner.energy.conditional, (None, 0, 0, 0))
    energies = quick_jit(conditional)(planner.params, memory, first, first)[:, 0]
    assert (np.asarray(energies)[:, :2].argmin(axis=1) == 1).all()


@pytest.mark.parametrize("terminated", [True, False])
@pytest.mark.parametrize("rewards", [[0.0, 0.0, 1.0], [1.0, 1.0, -3.0], [-1.0, -2.0, 20.0]])
def test_value_range_covers_zero_and_returns_of_recombined_steps(rewards, terminated):
    """Steps after the eighth change a return by at most 48 times their discount."""
    discount = 0.5
    data = [Demonstration(np.zeros(4), np.zeros(3, np.int32), np.array(rewards), terminated,
                          not terminated, 0)]  # fmt: skip
    steps, last = (rewards[:-1], rewards[-1:]) if terminated else (rewards, [0.0])
    found = [
        sum(discount**t * reward for t, reward in enumerate((*middle, end)))
        for length in range(9)
        for middle in itertools.product(steps, repeat=length)
        for end in last
        if terminated or length == 8
    ]
    allowed = value_range.find_value_range(discount, data)
    np.testing.assert_allclose(allowed, (min(0, *found), max(0, *found)), rtol=0, atol=48 * 0.5**8)


def test_without_a_discount_only_termination_bounds_the_value_range():
    episode = Demonstration(
        np.zeros(3), np.zeros(2, np.int32), np.array([0.0, 1.0]), True, False, 0
    )
    assert value_range.find_value_range(1.0, [episode]) == (0, 1)
    cut = episode._replace(terminated=False, truncated=True)
    assert value_range.find_value_range(1.0, [episode, cut]) == (0, np.inf)


@pytest.mark.parametrize(("method", "value"), [("bcq", 1.2), ("iql", -0.2), ("bc", 1.2)])
def test_values_outside_the_value_range_give_a_warning(method, value, monkeypatch):
    """A method that learns no values, such as bc, gives no warning."""

    def train(step, state, choose_data, key, steps, report):
        for mean in (7.0, 1.05, value):  # only the last counts
            report(steps, state, {"value": mean})
        return state

    monkeypatch.setattr(fitting, "make_begin", make_begin)
    monkeypatch.setattr(fitting, "train", train)
    domain = leap.make_domain("gymnasium", "SlipperyCorridor-v0")
    episode = Demonstration(
        np.array([0, 1, 1]), np.int32([1, 1]), np.float32([0, 1]), True, False, 0
    )
    with warnings.catch_warnings(record=True, action="always") as caught:
        leap.fit([episode], domain, method, model=SMALL)
    found = [str(each.message) for each in caught if "rewards allow 0 to 1" in str(each.message)]
    assert len(found) == (method != "bc")
