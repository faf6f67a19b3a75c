"""Environments of one's own: what they may look like, what goes wrong, the program at toy size."""

import warnings
from collections import OrderedDict

import gymnasium as gym
import jax
import numpy as np
import pytest
from gymnasium import spaces
from minari import DataCollector

from experiments import gymnasium as program
from experiments.common import config, results
from leapjax import domains
from leapjax.domain import blank_context
from leapjax.errors import UserError
from leapjax.gymnasium.domain import GYMNASIUM, Settings, make
from leapjax.gymnasium.observations import Part, StateTokens, blank_of, check_choices, parts_of
from tests.parameters import random_like
from tests.programs import SMALL

WAY = 5


class Corridor(gym.Env):
    """Go right until the end; what is seen is a picture, a number, and a choice."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict(
        picture=spaces.Box(0, 255, (WAY, 3, 3), np.uint8),
        here=spaces.Box(-np.inf, np.inf, (2,)),
        lamp=spaces.Discrete(3),
    )
    trouble = ""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self.seen(), {}

    def seen(self):
        picture = np.zeros((WAY, 3, 3), np.uint8)
        picture[self.place] = 200
        here = np.array([self.place, 0.01], np.float32)
        return {"picture": picture, "here": here, "lamp": self.place % 3}

    def step(self, action):
        if self.trouble == "raises":
            raise RuntimeError("the lamp\nis broken")
        self.place = max(0, self.place + 2 * int(action) - 1)
        seen, over = self.seen(), self.place == WAY - 1
        if self.trouble == "grows":
            seen["here"] = np.zeros(3, np.float32)
        return seen, float(over), over, False, {}


class Raises(Corridor):
    trouble = "raises"


class Grows(Corridor):
    trouble = "grows"


class Deep(Corridor):
    observation_space = spaces.Dict(
        below=spaces.Dict(
            level=spaces.Discrete(6, start=-2), two=spaces.MultiDiscrete([3, 4], start=[0, -1])
        )
    )

    def seen(self):
        below = OrderedDict(level=self.place - 2, two=np.array([0, -1]))
        return OrderedDict(below=below)


class Odd(Corridor):
    def __init__(self, way, lamp):
        self.made_with = way, lamp


class Held(Corridor):
    """Counts how many are open; the third cannot be closed."""

    made = closed = 0

    def __init__(self, **arguments):
        super().__init__(**arguments)
        Held.made += 1

    def close(self):
        Held.closed += 1
        if Held.closed == 3:
            raise OSError("the port is gone")


@pytest.fixture(autouse=True, scope="module")
def registered():
    kinds = {"Corridor": Corridor, "Raises": Raises, "Grows": Grows, "Deep": Deep, "Held": Held}
    for name, kind in kinds.items():
        gym.register(f"{name}-v0", f"tests.test_gymnasium:{kind.__name__}", max_episode_steps=12)
    gym.register("Endless-v0", "tests.test_gymnasium:Corridor")
    odd = {"way": np.zeros(2), "lamp": {len}}  # nothing that JSON has
    gym.register("Odd-v0", "tests.test_gymnasium:Odd", max_episode_steps=9, kwargs=odd)
    yield
    for name in (*kinds, "Endless", "Odd"):
        del gym.registry[f"{name}-v0"]


def recorded(name, level, policy, episodes, **arguments):
    """A data set of a policy, as Minari's collector writes it."""
    made = gym.make(level, disable_env_checker=True, **arguments)
    env = DataCollector(made, jpeg_encoding=False)
    for seed in range(episodes):
        seen, _ = env.reset(seed=seed)
        over = False
        while not over:
            seen, _, terminated, truncated, _ = env.step(policy(seen))
            over = terminated or truncated
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.create_dataset(name)
    env.close()
    return name


def test_spaces_become_blank_observations_and_parts():
    space = Corridor.observation_space
    blank = blank_of(space, "it")
    assert [leaf.shape for leaf in jax.tree.leaves(blank)] == [(2,), (), (WAY, 3, 3)]
    assert parts_of(space) == (Part("numbers"), Part("choices", 3), Part("image"))
    several = spaces.MultiDiscrete([4, 9], start=[1, 1])
    assert parts_of(several) == (Part("choices", 10),) and blank_of(several, "it").shape == (2,)
    assert parts_of(spaces.MultiBinary(3)) == (Part("numbers"),)
    with pytest.raises(UserError, match=r"it\['said'\] is a Text: expected Box"):
        blank_of(spaces.Dict(said=spaces.Text(5)), "it")


def test_a_state_is_a_token_and_its_parts_are_read():
    domain = make("Corridor-v0", Settings())
    context = blank_context(domain, 2)
    for num_actions in (0, 3):
        module = StateTokens(parts_of(Corridor.observation_space), 8, num_actions)
        params = random_like(jax.eval_shape(module.init, jax.random.key(0), context))
        encode = jax.jit(module.apply)
        tokens = encode(params, context)
        assert tokens.shape == (3, 8)
        for field, value in {"here": [0.0, 0.5], "lamp": 2, "picture": 9}.items():
            seen = {**context.observation}
            seen[field] = np.full_like(seen[field], value)
            changed = encode(params, context._replace(observation=seen))
            np.testing.assert_allclose(changed[:-1], tokens[:-1], atol=1e-6)
            assert np.abs(changed[-1] - tokens[-1]).max() > 1e-3, field
        acted = encode(params, context._replace(actions=np.array([0, 1], np.int32)))
        assert np.any(acted != tokens) == bool(num_actions)


def test_success_is_what_the_environment_says_or_the_user():
    def play(domain, actions):
        adapter = domain.make_adapter()
        adapter.reset(0)
        return [adapter.step(action).success for action in actions]

    assert play(make("Corridor-v0", Settings()), [1] * 4) == [False] * 3 + [True]
    assert play(make("Corridor-v0", Settings(success_return=2.0)), [1] * 4) == [False] * 4
    # CartPole's authors ask for a return of 475: to fall is no success, though it is rewarded.
    assert not any(play(make("CartPole-v1", Settings()), [0] * 11))
    assert any(play(make("CartPole-v1", Settings(success_return=5.0)), [0] * 11))
    # What is given up by the rollout is judged by what it had until then.
    assert play(make("CartPole-v1", Settings(success_return=2.0)), [0] * 3)[:2] == [False, True]
    # What is asked of MountainCar is not to lose more than 110, which nobody has at the start.
    assert not any(play(make("MountainCar-v0", Settings()), [1] * 20))
    assert make("Odd-v0", Settings()).arguments is None
    short = make("Corridor-v0", Settings(max_steps=2))
    assert short.max_steps == 2 and make("Endless-v0", Settings(max_steps=7)).max_steps == 7
    adapter = short.make_adapter()
    adapter.reset(0)
    assert [adapter.step(0).truncated for _ in range(2)] == [False, True]


@pytest.mark.parametrize(
    ("level", "says"),
    [
        ("CartPol-v1", "cannot be made: .*; did you mean CartPole-v1"),
        ("no_such_module:Own-v0", "cannot be made: .*no_such_module"),
        ("Pendulum-v1", "has actions Box.*: expected Discrete"),
        ("Endless-v0", "no limit of steps, so an episode may never end: .*--max-steps"),
    ],
)
def test_environments_that_cannot_be_used_are_one_line(level, says, capsys):
    with pytest.raises(UserError, match=says):
        make(level, Settings())
    assert program.main(["--env", level]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("level", "says"),
    [
        ("Raises-v0", "step of Raises-v0 raised RuntimeError: the lamp"),
        ("Grows-v0", "gave an observation of shape .*its observation space says"),
    ],
)
def test_environments_that_go_wrong_are_one_line(level, says, tmp_path, monkeypatch, capsys):
    adapter = make(level, Settings()).make_adapter()
    adapter.reset(0)
    with pytest.raises(UserError, match=says):
        adapter.step(1)
    monkeypatch.chdir(tmp_path)
    random = "--method random --demos 0 --episodes 2 --no-pictures".split()
    assert program.main(["--env", level, *random]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_without_data_it_says_what_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert program.main(["--env=Corridor-v0", *SMALL, "--steps", "1"]) == 2
    assert "Corridor-v0 has no demonstrator: name a Minari data set" in capsys.readouterr().err


def test_it_learns_from_a_data_set_and_plays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = recorded("my/corridor-v0", "Corridor-v0", lambda seen: 1, 4)
    (chosen,) = config.parse("gymnasium", ["--demonstrations", name])
    assert (chosen.level, chosen.demos) == ("Corridor-v0", 4)  # as the data say
    options = [*SMALL, "--horizon", "3", "--context", "1", "--steps", "40"]
    assert program.main(["--dataset", name, *options]) == 0
    (row,) = results.read(tmp_path / "runs" / "gymnasium.jsonl")
    assert row["successes"] == 3 and row["mean_return"] == 1.0 and row["mean_length"] == WAY - 1
    assert domains.find_domain("gymnasium") is GYMNASIUM


def test_data_of_an_environment_that_a_module_registers(tmp_path, monkeypatch, quick_begin):
    """Data know the environment by its id, without the module."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    register = 'gym.register("Theirs-v0", "tests.test_gymnasium:Corridor", max_episode_steps=12)'
    (tmp_path / "their_corridor.py").write_text(f"import gymnasium as gym\n{register}\n")
    try:
        name = recorded("my/theirs-v0", "their_corridor:Theirs-v0", lambda seen: 1, 2)
        options = [*SMALL, "--horizon", "3", "--steps", "0"]
        assert program.main(["--env", "their_corridor:Theirs-v0", "--dataset", name, *options]) == 0
    finally:
        gym.registry.pop("Theirs-v0", None)


def test_data_of_other_arguments_are_refused_until_they_are_given(
    tmp_path, monkeypatch, capsys, quick_begin
):
    monkeypatch.chdir(tmp_path)
    large = {"map_name": "8x8", "is_slippery": False}
    name = recorded("my/lake-v0", "FrozenLake-v1", lambda seen: 2, 2, **large)
    options = ["--dataset", name, *SMALL, "--horizon", "3", "--steps", "0"]
    assert program.main(options) == 2
    said = capsys.readouterr().err
    asked = '{"map_name": "8x8", "is_slippery": false}'
    assert "recorded in FrozenLake-v1 with other arguments" in said
    assert f"--arguments '{asked}'" in said and said.count("\n") == 1
    for other in ('{"is_slippery": false}', '{"map_name": "8x8"}'):  # and all are named again
        assert program.main([*options, "--arguments", other]) == 2
        assert f"--arguments '{asked}'" in capsys.readouterr().err
    assert program.main([*options, "--arguments", asked]) == 0
    assert make("FrozenLake-v1", Settings(arguments=asked)).signature["parts"] == [
        ["choices", 64, 0]
    ]
    for wrong in ("[]", "{", "8x8"):
        with pytest.raises(ValueError, match="arguments must be a JSON object like"):
            Settings(arguments=wrong)


def test_choices_below_zero_are_told_apart():
    """A one-hot code that is counted from 0 would be nothing for all of them."""
    parts = parts_of(Deep.observation_space)
    assert parts == (Part("choices", 6, -2), Part("choices", 4, -1))
    module = StateTokens(parts, 8, 0)
    context = blank_context(make("Deep-v0", Settings()), 0)
    params = random_like(jax.eval_shape(module.init, jax.random.key(0), context))
    encode = jax.jit(module.apply)
    seen = [
        {"below": {"level": np.int64(level), "two": np.array([0, 0])}} for level in range(-2, 3)
    ]
    tokens = [encode(params, context._replace(observation=each))[-1] for each in seen]
    for index, token in enumerate(tokens):
        for other in tokens[:index]:
            assert np.abs(token - other).max() > 1e-3


def test_dicts_of_any_kind_are_observations():
    adapter = make("Deep-v0", Settings()).make_adapter()
    assert adapter.reset(0) == {"below": {"level": -2, "two": pytest.approx([0, -1])}}
    assert adapter.step(1).observation["below"]["level"] == -1


def test_choices_that_there_are_not_are_refused():
    several = spaces.Dict(one=spaces.Discrete(3, start=2), more=spaces.MultiDiscrete([2, 4]))
    good = {"one": np.array([2, 4]), "more": np.array([[0, 0], [1, 3]])}
    check_choices(several, good, "episode 0")
    with pytest.raises(UserError, match="episode 0: one: a choice of 1, expected 2 to 4"):
        check_choices(several, {**good, "one": np.array([1, 4])}, "episode 0")
    with pytest.raises(UserError, match="episode 0: more: a choice of 2, expected 0 to 1"):
        check_choices(several, {**good, "more": np.array([[0, 0], [2, 3]])}, "episode 0")
    with pytest.raises(UserError, match="a choice of 16, expected 0 to 15"):
        make("FrozenLake-v1", Settings()).check(np.array([16]), "episode 0")


def test_what_is_made_is_closed(monkeypatch):
    for count in ("made", "closed"):
        monkeypatch.setattr(Held, count, 0)
    domain = make("Held-v0", Settings())
    assert Held.made == Held.closed == 1
    adapter = domain.make_adapter()
    adapter.reset(0)
    adapter.close()
    assert Held.made == Held.closed == 2
    with pytest.raises(UserError, match="close of Held-v0 raised OSError: the port is gone"):
        domain.make_adapter().close()
