"""Networks read every supported observation space; errors name the other spaces."""

import dataclasses
import itertools

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from leapjax import pretrained
from leapjax.configuration import specify
from leapjax.data import storage
from leapjax.domain import apply_statistics, blank_context
from leapjax.domains.gymnasium.domain import Settings, make
from leapjax.domains.gymnasium.observations import (
    MOST_INPUTS,
    Part,
    StateTokens,
    blank_of,
    check_precision,
    measure_parts,
    parts_of,
)
from leapjax.domains.gymnasium.scaling import (
    BINS,
    UNMEASURED,
    count_bins,
    find_knots,
    scale_numbers,
)
from leapjax.errors import UserError
from leapjax.running import command_line
from leapjax.types import Demonstration
from tests import toy
from tests.parameters import random_like
from tests.programs import SMALL
from tests.quick import quick_jit
from tests.test_gymnasium import recorded


class Long(gym.Env):
    """Observes an integer that int32 cannot hold."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(0, 2**40, (1,), np.int64)
    state = 2**32 + 2

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([self.state]), {}

    def step(self, action):
        return np.array([self.state]), 1.0, True, False, {}


class Stray(Long):
    """Observes a choice outside its space."""

    observation_space = spaces.MultiDiscrete([3])
    state = 3


@pytest.fixture(autouse=True, scope="module")
def registered():
    for kind in (Long, Stray):
        entry = f"tests.test_gymnasium_observations:{kind.__name__}"
        gym.register(f"{kind.__name__}-v0", entry, max_episode_steps=9)
    yield
    del gym.registry["Long-v0"], gym.registry["Stray-v0"]


def compute_features(states, knots=None):
    """Returns features `[n, 16]` of numbers `[n]`, by default with knots of these numbers.

    The numbers are padded to one shape, so all tests share a few programs.
    """
    states = np.asarray(states)
    knots = find_knots(states[:, None], BINS) if knots is None else knots
    table = np.zeros((12, 2), states.dtype)
    table[: len(states), 0] = states
    others = tuple(float(number) for number in range(BINS + 1))
    features = scale_numbers(jnp.asarray(table), (*knots, others))
    return np.asarray(features)[: len(states), :BINS]


SAMPLES = [
    ([100, 200], "float32"), ([1e-6, 2e-6], "float32"), ([1e9, 1.1e9], "float32"),
    ([1e6 - 1, 1e6, 1e6 + 1], "float32"), ([-3.4e38, 0, 3.4e38], "float32"),
    ([0, 0.5, 1, 1e9], "float32"), ([-1e-30, 1e-30, 1], "float32"),
    ([2**31 - 2, 2**31 - 1], "int32"), ([-(2**31), -(2**31) + 1, 0, 2**31 - 1], "int32"),
    ([2**32 - 2, 2**32 - 1], "uint32"), ([0, 1], "uint8"), ([254, 255], "uint8"),
    ([-128, 127], "int8"), ([30000, 30001], "int16"), ([False, True], "bool"),
]  # fmt: skip


def test_distinct_numbers_of_any_size_and_type_have_distant_features():
    for states, dtype in SAMPLES:
        features = compute_features(np.array(states, dtype))
        assert np.isfinite(features).all()
        for one, other in itertools.combinations(features, 2):
            assert np.abs(one - other).max() == 2  # from one end of an interval to the other


def test_features_resolve_values_where_data_are_dense():
    rng = np.random.default_rng(0)
    usual = rng.uniform(0, 1, 2000)
    odd = np.where(rng.random(2000) < 0.05, 1e9, usual)  # 1e9 marks missing values
    two = np.concatenate([usual, 1e6 + usual])
    tail = np.where(rng.random(2000) < 0.99, 0, rng.integers(1, 256, 2000))  # as in dark pictures
    counts = np.floor(rng.pareto(1.0, 2000) * 5)
    for states, one, other in [
        (odd, 0.3, 0.6), (two, 0.25, 0.75), (two, 1e6 + 0.25, 1e6 + 0.75), (tail, 0, 20),
        (tail, 100, 140), (counts, 0, 3), (1e6 * usual - 5e5, -1e5, 1e5), (-usual, -0.9, -0.8),
    ]:  # fmt: skip
        knots = find_knots(states.astype(np.float32)[:, None], BINS)
        assert len(knots[0]) <= BINS + 1 and list(knots[0]) == sorted(set(knots[0]))
        assert set(knots[0]) <= set(states.astype(np.float32).tolist())  # exact: from the data
        features = compute_features(np.array([one, other], np.float32), knots)
        assert np.abs(features[0] - features[1]).sum() > 0.5, (one, other)


def test_features_beyond_the_training_data_are_monotonic_and_small():
    knots = ((0.0, 1.0, 3.0),)
    states = np.array([-1e30, -10, -1, -1e-3, 0, 0.5, 1, 2, 3, 3.001, 9, 3e38], np.float32)
    features = compute_features(states, knots)
    assert np.isfinite(features).all() and np.abs(features).max() < 200
    assert (np.diff(features.sum(axis=1)) > 0).all()
    assert features[3, :3] == pytest.approx([-1.002, -1, 0], abs=1e-5)
    # A number that is constant in the data has no features.
    assert not compute_features(np.array([5, 7], np.float32), ((5.0,),)).any()
    # Without data, features resolve numbers of every size.
    seen = compute_features(np.array([-1e6, -3, -0.02, 0, 0.005, 2, 100, 200, 1e9]), UNMEASURED)
    assert (np.diff(seen.sum(axis=1)) > 0.1).all()


@pytest.mark.parametrize(
    ("space", "part", "dtype"),
    [
        (spaces.Box(-1, 1, (2,), np.float64), Part("vector"), np.float32),
        (spaces.Box(0, 2**64 - 1, (2,), np.uint64), Part("vector"), np.uint32),
        (spaces.Box(0, 1, (2,), bool), Part("vector"), bool),
        (spaces.Box(0, 255, (84, 84), np.uint8), Part("picture"), np.uint8),
        (spaces.MultiBinary([2, 3]), Part("vector"), np.int8),
        (spaces.Discrete(3, dtype=np.uint8), Part("choices", 3), np.int32),
        (spaces.MultiDiscrete([4, 9], start=[1, 1]), Part("choices", 10), np.int32),
        # Choices far from zero, or below zero, are counted from the first choice.
        (spaces.Discrete(3, start=10**9), Part("choices", 3, 10**9), np.int32),
        (spaces.MultiDiscrete([3, 4], start=[-1, 0]), Part("choices", 5, -1), np.int32),
    ],
)
def test_blank_observations_have_types_that_jax_supports(space, part, dtype):
    blank = blank_of(space, "it")
    assert blank.dtype == dtype and blank.shape == space.shape
    assert parts_of(space) == (part,)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Text(5), "it is a Text: expected Box"),
        (spaces.Tuple([spaces.Discrete(2)]), "it is a Tuple: .*FlattenObservation"),
        (spaces.Dict(), "expected a Dict with names"),
        (spaces.Box(0, 1, (0,)), r"it is of shape \(0,\): it holds no numbers"),
        (spaces.Discrete(10**9), "one-hot code of 1000000000 numbers: .*TransformObservation"),
        (spaces.Dict(at=spaces.MultiDiscrete([2, 10**6])), r"it\['at'\] is MultiDiscrete"),
        (spaces.Discrete(3, start=2**40), "do not fit int32"),
        (spaces.Box(0, 255, (2000, 1000, 3), np.uint8), "at most 1048576; .*ResizeObservation"),
    ],
    ids=str,
)
def test_unsupported_spaces_raise_an_error_that_names_them(space, message):
    with pytest.raises(UserError, match=message):
        blank_of(space, "it")


PICTURES = {
    "binary": ((6, 5, 1), np.uint8, 1), "bright": ((6, 6, 3), np.uint8, 255),
    "first": ((3, 14, 14), np.float32, 1e-3), "board": ((8, 8, 11), bool, True),
    "wide": ((2, 4, 9), np.int16, -300),
}  # fmt: skip


def make_demonstration(observations):
    states = len(jax.tree.leaves(observations)[0])
    zeros = np.zeros(states - 1)
    return Demonstration(observations, zeros.astype(np.int32), zeros, True, False, 0)


def test_networks_read_pictures_of_any_layout_and_range():
    """`parts_of` finds the channels, and one changed number changes the tokens."""
    dark = {name: np.zeros(shape, dtype) for name, (shape, dtype, _) in PICTURES.items()}
    states = {
        name: np.stack([dark[name], np.full_like(dark[name], most)])
        for name, (*_, most) in PICTURES.items()
    }
    space = {name: spaces.Box(0, 1, zeros.shape, zeros.dtype) for name, zeros in dark.items()}
    parts = parts_of(spaces.Dict(space))
    assert {part.kind for part in parts} == {"picture"}
    statistics = measure_parts(parts, [make_demonstration(states)])
    assert [len(knots) for knots in statistics] == [1, 11, 3, 3, 2]  # in alphabetic order
    assert statistics[0] == ((0.0, 1.0),) and statistics[2] == ((0.0, 255.0),) * 3
    module = StateTokens(parts, 8, 0, statistics=statistics)
    context = blank_context(toy.DOMAIN._replace(blank=dark), 0)
    params = random_like(jax.eval_shape(module.init, jax.random.key(0), context))
    encode = quick_jit(module.apply)
    before = encode(params, context)
    for name, zeros in dark.items():
        corner = zeros.copy()
        corner.flat[-1] = PICTURES[name][2]
        seen = encode(params, context._replace(observation={**dark, name: corner}))
        assert np.abs(seen - before).max() > 1e-3, name


def test_statistics_cover_only_numbers_of_the_training_data():
    assert measure_parts((Part("choices", 3),), [make_demonstration(np.zeros(2, np.int32))]) == ()
    assert measure_parts((Part("vector"),), []) == ()
    rng = np.random.default_rng(0)
    several = [make_demonstration(rng.normal(size=(n, 2)).astype(np.float32)) for n in (5, 40, 9)]
    (knots,) = measure_parts((Part("vector"),), several)
    states = np.concatenate([each.observations for each in several])
    assert [column[0] for column in knots] == states.min(axis=0).tolist()
    assert [column[-1] for column in knots] == states.max(axis=0).tolist()
    # The checkpoint stores the knots, so all numbers of a large array share them.
    large = make_demonstration(np.arange(3 * 20_000, dtype=np.float32).reshape(3, 20_000))
    (shared,) = measure_parts((Part("vector"),), [large])
    assert len(shared) == 1 and len(shared[0]) == count_bins(20_000) + 1 == 5
    assert (shared[0][0], shared[0][-1]) == (0, 3 * 20_000 - 1)
    assert count_bins(1) == BINS and count_bins(MOST_INPUTS // 4) == 4


def test_specification_stores_the_statistics(tmp_path):
    domain = make("CartPole-v1", Settings())
    data = [make_demonstration(np.arange(12, dtype=np.float32).reshape(3, 4) % 8)]
    (chosen,) = command_line.parse(
        "gymnasium", ["--level=CartPole-v1", *SMALL, "--steps=0", "--demos=0"]
    )
    before = specify(chosen, 0, domain)
    after = dataclasses.replace(before, statistics=domain.scaling.measure(data))
    assert after.statistics[0][0] == (0.0, 4.0)
    assert "statistics" not in pretrained.describe_identity(before)  # as in older checkpoints
    assert pretrained.describe_identity(before) != pretrained.describe_identity(after)
    pretrained.save_specification(tmp_path, after)
    assert pretrained.parse_specification(tmp_path) == after
    made = pretrained.make_domain(after).encoders["paper"](chosen.model, 0)
    assert made.statistics == after.statistics
    knots = ((1.0,),) * 3
    for wrong in ((knots,), ((*knots, (2.0, 1.0)),), ((*knots, (np.nan,)),)):
        with pytest.raises(UserError, match="not of this observation space: train it again"):
            apply_statistics(domain, wrong)


def test_changes_too_small_for_float32_raise_an_error():
    space = spaces.Dict(now=spaces.Box(0, np.inf, (2,), np.float64), near=spaces.Box(0, 1, (1,)))
    steps = np.arange(4.0)[:, None]
    near = 1 + 1e-9 * steps
    for fine in (1e5 + steps, 1 + 1e-15 * steps, 1e300 * steps):
        check_precision(space, {"now": np.hstack([steps, fine]), "near": near}, "it")
    with pytest.raises(UserError, match=r"it: now: the numbers at \[1\] change by too little"):
        check_precision(space, {"now": np.hstack([steps, 1.7e9 + steps]), "near": near}, "it")


def test_out_of_range_observations_raise_an_error_in_data_and_in_play():
    domain = make("Long-v0", Settings())
    name = recorded("my/long-v0", "Long-v0", lambda seen: 0, 1)
    message = "numbers that do not fit int32, or are not finite, such as 4294967298"
    with pytest.raises(UserError, match=f"episode 0 of .*: observations: {message}"):
        storage.load(name, domain)
    with pytest.raises(UserError, match=f"an observation of Long-v0: {message}"):
        domain.make_adapter().reset(0)
    with pytest.raises(UserError, match="an observation of Stray-v0: a choice of 3, expected 0 to"):
        make("Stray-v0", Settings()).make_adapter().reset(0)
