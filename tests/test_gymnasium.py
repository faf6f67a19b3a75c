"""Environments of one's own: what they may look like, what goes wrong, the program at toy size."""

import dataclasses
import json
import types
import warnings
from collections import OrderedDict

import gymnasium as gym
import jax
import numpy as np
import pytest
from flax.core import FrozenDict
from gymnasium import spaces
from gymnasium.wrappers import (
    FrameStackObservation,
    RecordEpisodeStatistics,
    RescaleObservation,
    StickyAction,
    TransformAction,
    TransformObservation,
    TransformReward,
)
from minari import DataCollector

from experiments import gymnasium as program
from leapjax import domains
from leapjax.data import storage, windows
from leapjax.data.storage.spaces import SPACES
from leapjax.domain import Collection, Demonstrations, Domain, blank_context
from leapjax.domains.gymnasium.domain import GYMNASIUM, Settings, make
from leapjax.domains.gymnasium.observations import (
    Part,
    StateTokens,
    blank_of,
    check_choices,
    parts_of,
)
from leapjax.domains.gymnasium.recorded import describe_environment
from leapjax.environments import Criterion, GymnasiumAdapter, Transition
from leapjax.errors import UserError
from leapjax.rollouts import evaluate
from leapjax.running import command_line, results
from leapjax.running.data import judge_data
from leapjax.types import Demonstration, Plan
from tests.parameters import random_like
from tests.programs import RANDOM, SMALL, only_long

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


def recorded(name, level, policy, episodes, wrap=lambda env: env, **arguments):
    """A data set of a policy, as Minari's collector writes it."""
    made = wrap(gym.make(level, disable_env_checker=True, **arguments))
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
    assert parts_of(space) == (Part("vector"), Part("choices", 3), Part("picture"))
    several = spaces.MultiDiscrete([4, 9], start=[1, 1])
    assert parts_of(several) == (Part("choices", 10),) and blank_of(several, "it").shape == (2,)
    assert parts_of(spaces.MultiBinary(3)) == (Part("vector"),)
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
    assert describe_environment(gym.make("Odd-v0")).arguments is None
    short = make("Corridor-v0", Settings(max_steps=2))
    assert short.max_steps == 2 and make("Endless-v0", Settings(max_steps=7)).max_steps == 7
    adapter = short.make_adapter()
    adapter.reset(0)
    assert [adapter.step(0).truncated for _ in range(2)] == [False, True]


def episode(rewards, terminated=True, truncated=False):
    steps = len(rewards)
    return Demonstration(
        np.zeros(steps + 1), np.zeros(steps, np.int32), np.array(rewards, np.float32),
        terminated, truncated, 0,
    )  # fmt: skip


def test_demonstrations_are_judged_as_episodes_that_are_played():
    class Scripted(Corridor):
        spec = None

        def __init__(self, demonstration):
            self.script = demonstration

        def reset(self, *, seed=None, options=None):
            self.place = self.count = 0
            return self.seen(), {}

        def step(self, action):
            self.count += 1
            d, last = self.script, self.count == len(self.script.rewards)
            marks = last and d.terminated, last and d.truncated
            return self.seen(), d.rewards[self.count - 1], *marks, {}

    data = [
        episode([1, 0, 0]), episode([0, 0, 1]), episode([5, -5, 1], False, True),
        episode([-1, -1], False, True), episode([9, -9]),
    ]  # fmt: skip
    domain = make("Corridor-v0", Settings())
    shares = {None: 1 / 5, 1.0: 3 / 5, 0.0: 4 / 5, -2.0: 1.0}
    for least, share in shares.items():
        criterion = Criterion(least, least is not None)
        found = judge_data(
            data, domain._replace(demonstrations=Demonstrations(criterion=criterion))
        )
        assert found == {"success": share, "return": pytest.approx(0.2)}
        played = []
        for each in data:
            adapter = GymnasiumAdapter(Scripted(each), least)
            adapter.reset(0)
            played.append([adapter.step(0).success for _ in each.rewards][-1])
        assert np.mean(played) == share
    assert judge_data(data, domain._replace(demonstrations=Demonstrations())) is None
    assert judge_data([], domain) is None


def test_a_criterion_says_where_it_comes_from():
    criteria = {
        name: make(name, Settings(success_return=least)).demonstrations.criterion
        for name, least in (("CartPole-v1", None), ("CartPole-v0", 3.0), ("Corridor-v0", None))
    }
    assert criteria["CartPole-v1"] == Criterion(475.0)
    assert "475 (reward_threshold of the environment, meant" in str(criteria["CartPole-v1"])
    assert str(criteria["CartPole-v0"]) == "a return of at least 3 (given)"
    assert criteria["Corridor-v0"] == Criterion(None)
    for wrong in (np.nan, np.inf):
        with pytest.raises(UserError, match="success_return must be finite"):
            make("CartPole-v1", Settings(success_return=wrong))


def row_of(**more):
    kinds = {name: "x" if kind is str else kind(1) for name, kind in results.FIELDS.items()}
    return {**kinds, "mean_return": 7.93, "paper_success": None, **more}


def test_tables_show_the_return_first_where_nobody_has_said_what_success_is():
    judged = {"criterion": "a return of at least 8 (x)", "data_success": 0.56, "data_return": 8.0}
    found, asked = (row_of(**judged, criterion_given=given) for given in (False, True))
    for rows, first in (([found], "return"), ([asked], "success [95%]"), ([row_of()], "success")):
        table = results.success_table(rows)
        assert str(table.columns[4].header).startswith(first)
        assert table.caption == (None if rows == [row_of()] else "success: " + judged["criterion"])
    assert results.summarize(found).startswith("mean return 7.93 (data: 8.00), success 100.0%")
    assert results.summarize(asked).startswith("success 100.0%")


@pytest.mark.parametrize(
    ("level", "says"),
    [
        ("CartPol-v1", "no 'CartPol-v1' is registered; .* MODULE:CartPol-v1; did you .*CartPole"),
        ("tests.toy:Corridr-v0", "no 'Corridr-v0' is registered; did you mean Corridor-v0"),
        # No other name is proposed where the cause is another.
        ("no_such_module:Own-v0", "cannot be made: no module 'no_such_module': install it"),
        ("Pendulum-v1", "has actions Box.*: expected Discrete"),
        ("Endless-v0", "no limit of steps, so an episode may never end"),
        ("CartPole-v9", "provides versioned environments"),
        ("ALF/Pong-v5", "no ALF/ is registered: install the package that has it"),
        ("Broken-v0", "Box3D is not installed, run `pip install box3d`"),
        ("Absent-v0", "no module 'no_such_physics': install it"),
        ("a:b:c", "expected its id, or MODULE:ID"),
        ("not an id", "Malformed environment ID"),
    ],
)
def test_environments_that_cannot_be_used_are_one_line(level, says, capsys):
    def broken():
        raise gym.error.DependencyNotInstalled("Box3D is not installed, run `pip install box3d`")

    gym.register("Broken-v0", broken, max_episode_steps=5)
    gym.register("Absent-v0", "no_such_physics.envs:Absent", max_episode_steps=5)
    try:
        with pytest.raises(UserError, match=says) as raised:
            make(level, Settings())
        assert ("did you mean" in str(raised.value)) == ("did you" in says)
        assert program.main(["--env", level]) == 2
    finally:
        del gym.registry["Broken-v0"], gym.registry["Absent-v0"]
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


def test_it_learns_from_a_data_set_and_plays(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert program.main(["--env=Corridor-v0", *SMALL, "--steps", "1"]) == 2
    assert "Corridor-v0 has no demonstrator: name a Minari data set" in capsys.readouterr().err
    name = recorded("my/corridor-v0", "Corridor-v0", lambda seen: 1, 4)
    (chosen,) = command_line.parse("gymnasium", ["--demonstrations", name])
    assert (chosen.level, chosen.demos) == ("Corridor-v0", 4)  # as the data say
    options = [*SMALL, "--horizon", "3", "--context", "1", "--steps", "40"]
    assert program.main(["--dataset", name, *options]) == 0
    (row,) = results.read(tmp_path / "runs" / "gymnasium.jsonl")
    assert row["successes"] == 3 and row["mean_return"] == 1.0 and row["mean_length"] == WAY - 1
    assert (row["data_success"], row["data_return"], row["criterion_given"]) == (1.0, 1.0, False)
    said = capsys.readouterr().out
    assert "mean return 1.00 (data: 1.00), success 100.0%" in " ".join(said.split())
    assert "success: a positive reward at the end (nobody has named a return)" in said
    assert domains.find_domain("gymnasium") is GYMNASIUM


def test_data_of_an_environment_that_a_module_registers(tmp_path, monkeypatch):
    """Data know the environment by its id, without the module."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    register = 'gym.register("Theirs-v0", "tests.test_gymnasium:Corridor", max_episode_steps=12)'
    (tmp_path / "their_corridor.py").write_text(f"import gymnasium as gym\n{register}\n")
    try:
        name = recorded("my/theirs-v0", "their_corridor:Theirs-v0", lambda seen: 1, 2)
        options = [*RANDOM, "--demos", "2", "--steps", "0"]
        assert program.main(["--env", "their_corridor:Theirs-v0", "--dataset", name, *options]) == 0
    finally:
        gym.registry.pop("Theirs-v0", None)


@only_long
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
    assert f"give it {asked} (--arguments)" in said and said.count("\n") == 1
    for other in ('{"is_slippery": false}', '{"map_name": "8x8"}'):  # and all are named again
        assert program.main([*options, "--arguments", other]) == 2
        assert f"give it {asked} (--arguments)" in capsys.readouterr().err
    assert program.main([*options, "--arguments", asked]) == 0
    assert make("FrozenLake-v1", Settings(arguments=asked)).signature["parts"] == [
        ["choices", 64, 0]
    ]
    for wrong in ("[]", "{", "8x8", "[" * 100_000):
        with pytest.raises(ValueError, match="arguments must be a JSON object like"):
            Settings(arguments=wrong)


class Dimmed(gym.ObservationWrapper):
    """A wrapper of the user's own, which says nothing of its arguments."""

    def observation(self, observation):
        return {**observation, "here": observation["here"] / 2}


class Renamed(Dimmed):
    """Another."""


def loaded(name, level, **options):
    return storage.load(name, make(level, Settings(**options))).demonstrations


@pytest.mark.parametrize(
    ("wrap", "says"),
    [
        (lambda env: RescaleObservation(env, -1.0, 1.0), "RescaleObservation .*min_obs.*-1.0"),
        (lambda env: StickyAction(env, 0.25), "StickyAction"),  # its spaces are the same
        (lambda env: RecordEpisodeStatistics(FrameStackObservation(env, 2)), "FrameStackObserv"),
    ],
)
def test_data_recorded_through_wrappers_are_refused_by_name(wrap, says):
    name = recorded("my/wrapped-v0", "MountainCar-v0", lambda seen: 1, 1, wrap)
    with pytest.raises(
        UserError, match=f"'{name}' was recorded with the wrappers {says}"
    ) as raised:
        loaded(name, "MountainCar-v0")
    assert "MountainCar-v0 is played with no wrappers" in str(raised.value)
    assert "MODULE:MountainCar-v0" in str(raised.value)


@pytest.mark.parametrize(
    ("wrap", "says"),
    [
        (lambda env: TransformReward(env, abs), "reward at step 0"),
        (lambda env: TransformObservation(env, lambda x: x[::-1], None), "first observation"),
        (lambda env: TransformAction(env, lambda a: 2 - a, None), "observation after step 0"),
        (lambda env: TransformReward(env, lambda r: r), None),  # changes nothing
        (RecordEpisodeStatistics, None),  # only watches
    ],
)
def test_wrappers_that_data_cannot_name_are_found_by_playing_again(wrap, says):
    """Minari keeps nothing of an environment if a wrapper was given a function."""
    name = recorded("my/wrapped-v0", "MountainCar-v0", lambda seen: 0, 1, wrap)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        assert len(loaded(name, "MountainCar-v0")) == 1
    told = [str(each.message) for each in warned if "may not have been recorded" in str(each)]
    assert len(told) == (says is not None)
    assert says is None or f"with its seed 0 has another {says}; look for wrappers" in told[0]


def test_an_environment_that_is_registered_with_its_wrappers():
    wrappers = [RescaleObservation.wrapper_spec(min_obs=np.float32(-1), max_obs=np.float32(1))]
    name = recorded(
        "my/scaled-v0", "MountainCar-v0", lambda seen: 1, 1,
        lambda env: RescaleObservation(env, -1.0, 1.0),
    )  # fmt: skip
    plain = recorded("my/plain-v0", "MountainCar-v0", lambda seen: 1, 1)
    before = gym.registry["MountainCar-v0"]
    try:
        gym.registry["MountainCar-v0"] = dataclasses.replace(
            before, additional_wrappers=tuple(wrappers)
        )
        (found,) = loaded(name, "MountainCar-v0")
        adapter = make("MountainCar-v0", Settings()).make_adapter()
        np.testing.assert_allclose(adapter.reset(0), found.observations[0], atol=1e-6)
        with pytest.raises(UserError, match="was recorded with no wrappers, and .*RescaleObs"):
            loaded(plain, "MountainCar-v0")
    finally:
        gym.registry["MountainCar-v0"] = before


def test_wrappers_of_the_users_own_are_compared_by_name():
    for kind, name in ((Dimmed, "my/dimmed-v0"), (Renamed, "my/renamed-v0")):
        recorded(name, "Corridor-v0", lambda seen: 1, 1, kind)
    gym.register("Dim-v0", lambda: Dimmed(Corridor()), max_episode_steps=12)
    try:
        assert len(loaded("my/dimmed-v0", "Dim-v0")) == 1
        for level, name in (("Dim-v0", "my/renamed-v0"), ("Corridor-v0", "my/dimmed-v0")):
            with pytest.raises(UserError, match="was recorded with the wrappers"):
                loaded(name, level)
    finally:
        del gym.registry["Dim-v0"]


def test_a_limit_of_steps_that_differs_is_the_users_choice():
    name = recorded("my/short-v0", "Corridor-v0", lambda seen: 1, 1, max_episode_steps=7)
    with pytest.raises(UserError, match=r"at most 7 steps, and Corridor-v0 ends them after 12: .*"):
        loaded(name, "Corridor-v0")
    for chosen in (7, 12, 9):
        assert len(loaded(name, "Corridor-v0", max_steps=chosen)) == 1


def saved_spaces(name, change):
    """Changes what a data set says of its spaces, as if it came from somewhere else."""
    path = storage.datasets_folder() / name / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    spaces = {each: json.loads(metadata[each]) for each in SPACES}
    change(spaces["observation_space"], spaces["action_space"])
    metadata |= {each: json.dumps(space) for each, space in spaces.items()}
    path.write_text(json.dumps(metadata))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda seen, acts: seen["low"].__setitem__(0, -0.5), "each observation is in Box"),
        (lambda seen, acts: acts.update(n=4), r"each action is in Discrete\(4\), and in Mount"),
        (lambda seen, acts: acts.update(start=1), r"each action is in Discrete\(3, start=1\)"),
        (lambda seen, acts: seen["low"].__setitem__(0, -1.2000001), None),  # another rounding
        (lambda seen, acts: seen.update(dtype="float64"), None),
    ],
)
def test_spaces_that_are_not_those_of_the_environment(change, says):
    name = recorded("my/car-v0", "MountainCar-v0", lambda seen: 1, 1)
    saved_spaces(name, change)
    if says is None:
        assert len(loaded(name, "MountainCar-v0")) == 1
        return
    with pytest.raises(UserError, match=says):
        loaded(name, "MountainCar-v0")


def test_a_part_of_a_space_is_named_and_bounds_without_end_are_equal():
    name = recorded("my/corridor-v0", "Corridor-v0", lambda seen: 1, 1)
    largest = float(np.finfo(np.float32).max)  # as environments of earlier versions have it
    saved_spaces(name, lambda seen, acts: seen["subspaces"]["here"].update(high=[largest] * 2))
    assert len(loaded(name, "Corridor-v0")) == 1
    saved_spaces(name, lambda seen, acts: seen["subspaces"]["lamp"].update(n=4))
    with pytest.raises(UserError, match=r"each observation\['lamp'\] is in Discrete\(4\)"):
        loaded(name, "Corridor-v0")


@pytest.mark.parametrize("level", ["Deep-v0", "MountainCar-v0"])
def test_what_leapjax_writes_of_an_environment_is_loaded_again(level):
    name, domain = recorded("my/first-v0", level, lambda seen: 1, 2), make(level, Settings())
    first = storage.load(name, domain)
    storage.save("my/again-v0", first, domain, "again")
    for one, other in zip(first.demonstrations, loaded("my/again-v0", level), strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)


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
    adapter = make("Deep-v0", Settings()).make_adapter()
    assert adapter.reset(0) == {"below": {"level": -2, "two": pytest.approx([0, -1])}}
    assert adapter.step(1).observation["below"]["level"] == -1


class Moody(gym.Env):
    """Each observation is another kind of mapping."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict(b=spaces.Discrete(9), a=spaces.Discrete(9))
    kinds = (OrderedDict, dict, types.MappingProxyType, FrozenDict)

    def reset(self, *, seed=None, options=None):
        self.count = seed  # episodes begin with different kinds
        return self.seen(), {}

    def seen(self):
        self.count += 1
        values = {"b": np.int64(self.count % 9), "a": np.int64(0)}
        return self.kinds[self.count % len(self.kinds)](values)

    def step(self, action):
        return self.seen(), 1.0, False, self.count > 12, {}


class Bare:
    """An adapter that is not ours: observations are as they come."""

    num_actions = 3

    def __init__(self, env):
        self.env = env

    def reset(self, seed):
        return self.env.reset(seed=seed)[0]

    def step(self, action):
        return Transition(*self.env.step(action)[:4], success=False)


@pytest.mark.parametrize("adapter", [GymnasiumAdapter, Bare])
def test_dicts_of_any_kind_are_one_structure_in_the_rollout(adapter):
    contexts = []

    class Planner:
        num_actions = 3

        def plan_next(self, params, keys, context, cache):
            contexts.append(context)
            return Plan(np.zeros((len(keys), 1), np.int32), *[None] * 3), None

    episodes = evaluate(lambda: adapter(Moody()), [1, 2, 3], Planner(), (), context=2)
    assert list(episodes.lengths) == [11, 10, 9]
    assert all(set(each.past) == {"a", "b"} and type(each.past) is dict for each in contexts)
    np.testing.assert_array_equal(contexts[2].past["b"], [[2, 3], [3, 4], [4, 5]])


def test_dicts_of_any_kind_are_one_structure_in_data(minari_folder):
    def nothing(*arguments):
        raise NotImplementedError

    blank = {"b": np.zeros((), np.int64), "a": np.zeros(2, np.float32)}
    seen = {"b": np.arange(3), "a": np.ones((3, 2), np.float32)}
    rest = np.zeros(2, np.int32), np.zeros(2, np.float32), True, False, storage.UNKNOWN_SEED
    kinds = (dict, OrderedDict, FrozenDict)
    domains = [Domain("Own", nothing, ("go", "end"), 9, kind(blank), {}) for kind in kinds]
    collection = Collection([Demonstration(kind(seen), *rest) for kind in kinds], {})
    storage.save("my/kinds-v0", collection, domains[0], "kinds")
    for domain in domains:
        found = storage.load("my/kinds-v0", domain).demonstrations
        context = blank_context(domain, 1)
        for demonstrations in (found, [*collection.demonstrations, *found]):
            joined = windows.concatenate(demonstrations).observations
            assert jax.tree.structure(joined) == jax.tree.structure(context.observation)
            np.testing.assert_array_equal(joined["b"], [0, 1, 2] * len(demonstrations))


def test_choices_that_there_are_not_are_refused():
    several = spaces.Dict(one=spaces.Discrete(3, start=2), more=spaces.MultiDiscrete([2, 4]))
    good = {"one": np.array([2, 4]), "more": np.array([[0, 0], [1, 3]])}
    check_choices(several, good, "episode 0")
    with pytest.raises(UserError, match="episode 0: one: a choice of 1, expected 2 to 4"):
        check_choices(several, {**good, "one": np.array([1, 4])}, "episode 0")
    with pytest.raises(UserError, match="episode 0: more: a choice of 2, expected 0 to 1"):
        check_choices(several, {**good, "more": np.array([[0, 0], [2, 3]])}, "episode 0")
    with pytest.raises(UserError, match="a choice of 16, expected 0 to 15"):
        make("FrozenLake-v1", Settings()).demonstrations.check(np.array([16]), "episode 0")


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
