"""Users' own environments: spaces, data sets, errors, and the program at toy size."""

import dataclasses
import itertools
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
    RecordEpisodeStatistics,
    RescaleObservation,
    StickyAction,
    TransformAction,
    TransformObservation,
    TransformReward,
)
from minari import DataCollector

from experiments import gymnasium as program
from leapjax import domains, pretrained
from leapjax.data import storage, windows
from leapjax.data.storage.spaces import SPACES
from leapjax.domain import Collection, Demonstrations, blank_context
from leapjax.domains.gymnasium.domain import GYMNASIUM, Settings, make
from leapjax.domains.gymnasium.observations import (
    StateTokens,
    check_choices,
    parts_of,
)
from leapjax.environments import GymnasiumAdapter, Transition
from leapjax.errors import UserError
from leapjax.rollouts import evaluate
from leapjax.running import command_line, results, train
from leapjax.running.data import judge_data
from leapjax.types import Demonstration, Plan
from tests import toy
from tests.parameters import random_like
from tests.programs import RANDOM, SMALL

LENGTH = 5


class Corridor(gym.Env):
    """Walk right to the end; an observation holds a picture, numbers and a choice."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict(
        picture=spaces.Box(0, 255, (LENGTH, 3, 3), np.uint8),
        here=spaces.Box(-np.inf, np.inf, (2,)),
        lamp=spaces.Discrete(3),
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self.view(), {}

    def view(self):
        picture = np.zeros((LENGTH, 3, 3), np.uint8)
        picture[self.place] = 200
        here = np.array([self.place, 0.01], np.float32)
        return {"picture": picture, "here": here, "lamp": self.place % 3}

    def step(self, action):
        self.place = max(0, self.place + 2 * int(action) - 1)
        over = self.place == LENGTH - 1
        return self.view(), float(over), over, False, {}


class Raises(Corridor):
    def step(self, action):
        raise RuntimeError("the lamp\nis broken")


class Grows(Corridor):
    def step(self, action):
        return {**self.view(), "here": np.zeros(3, np.float32)}, *super().step(action)[1:]


class Deep(Corridor):
    observation_space = spaces.Dict(
        below=spaces.Dict(
            level=spaces.Discrete(6, start=-2), two=spaces.MultiDiscrete([3, 4], start=[0, -1])
        )
    )

    def view(self):
        below = OrderedDict(level=self.place - 2, two=np.array([0, -1]))
        return OrderedDict(below=below)


class Held(Corridor):
    """Counts how many are made and closed; closing the third fails."""

    made = closed = 0

    def __init__(self, **arguments):
        super().__init__(**arguments)
        Held.made += 1

    def close(self):
        Held.closed += 1
        if Held.closed == 3:
            raise OSError("the port is gone")


@pytest.fixture(autouse=True, scope="module")
def register_environments():
    before = {*gym.registry}
    for kind in (Corridor, Raises, Grows, Deep, Held):
        entry = f"tests.test_gymnasium:{kind.__name__}"
        gym.register(f"{kind.__name__}-v0", entry, max_episode_steps=12)
    gym.register("Endless-v0", Corridor)
    gym.register("Dim-v0", lambda: Dimmed(Corridor()), max_episode_steps=12)
    scale = RescaleObservation.wrapper_spec(min_obs=np.float32(-1), max_obs=np.float32(1))
    gym.registry["Scaled-v0"] = dataclasses.replace(
        gym.spec("MountainCar-v0"), id="Scaled-v0", additional_wrappers=(scale,)
    )
    yield
    for name in {*gym.registry} - before:
        del gym.registry[name]


def recorded(name, level, policy, episodes, wrap=lambda env: env, **arguments):
    """Records episodes of a policy with Minari's collector; returns the data set's name."""
    made = wrap(gym.make(level, disable_env_checker=True, **arguments))
    env = DataCollector(made, jpeg_encoding=False)
    for seed in range(episodes):
        view, _ = env.reset(seed=seed)
        over = False
        while not over:
            view, _, terminated, truncated, _ = env.step(policy(view))
            over = terminated or truncated
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.create_dataset(name)
    env.close()
    return name


def test_encoder_reads_all_parts_of_a_state_into_one_token():
    domain = make("Corridor-v0", Settings())
    context = blank_context(domain, 2)
    for num_actions in (0, 3):  # 0: past actions are not read
        module = StateTokens(parts_of(Corridor.observation_space), 8, num_actions)
        params = random_like(jax.eval_shape(module.init, jax.random.key(0), context))
        encode = jax.jit(module.apply)
        tokens = encode(params, context)
        assert tokens.shape == (3, 8)
        for field, value in {"here": [0.0, 0.5], "lamp": 2, "picture": 9}.items():
            other = np.full_like(context.observation[field], value)
            view = context._replace(observation={**context.observation, field: other})
            changed = encode(params, view)
            np.testing.assert_allclose(changed[:-1], tokens[:-1], atol=1e-6)
            assert np.abs(changed[-1] - tokens[-1]).max() > 1e-3, field
        acted = encode(params, context._replace(actions=np.array([0, 1], np.int32)))
        assert np.any(acted != tokens) == bool(num_actions)


def test_success_is_defined_by_the_environment_or_a_given_return():
    def play(domain, actions):
        adapter = domain.make_adapter()
        adapter.reset(0)
        return [adapter.step(action).success for action in actions]

    for level, threshold, actions, successes in [
        ("Corridor-v0", None, [1] * 4, [False, False, False, True]),
        ("Corridor-v0", 2.0, [1] * 4, [False] * 4),
        # CartPole's authors require a return of 475: falling is rewarded, but no success.
        ("CartPole-v1", None, [0] * 11, [False] * 11),
        # Episodes that the rollout gives up are judged by their return so far.
        ("CartPole-v1", 2.0, [0] * 3, [False, True, True]),
        # MountainCar requires a return of -110: unfinished episodes have more, but no success.
        ("MountainCar-v0", None, [1] * 20, [False] * 20),
    ]:
        assert play(make(level, Settings(success_return=threshold)), actions) == successes
    assert make("Endless-v0", Settings(max_steps=7)).max_steps == 7
    adapter = make("Corridor-v0", Settings(max_steps=2)).make_adapter()
    adapter.reset(0)
    assert [adapter.step(0).truncated for _ in range(2)] == [False, True]


def test_demonstrations_are_judged_like_played_episodes():
    for threshold in (None, 1.0, 0.0, 0.5):
        domain = make("Corridor-v0", Settings(success_return=threshold))
        data, played = [], []
        for actions in ([1] * 4, [0] * 12, [1, 0, 1, 1, 1, 1]):
            adapter = domain.make_adapter()
            states = [adapter.reset(0)]
            steps = [adapter.step(action) for action in actions]
            states = jax.tree.map(lambda *x: np.stack(x), *states, *(s.observation for s in steps))
            rewards = np.array([step.reward for step in steps], np.float32)
            end = steps[-1].terminated, steps[-1].truncated
            data.append(Demonstration(states, np.array(actions, np.int32), rewards, *end, 0))
            played.append(steps[-1].success)
        found = judge_data(data, domain)
        assert found == {"success": np.mean(played), "return": pytest.approx(2 / 3)}
        assert found["success"] == (1.0 if threshold == 0 else pytest.approx(2 / 3))
    assert (
        judge_data(data, domain._replace(demonstrations=Demonstrations()))
        is judge_data([], domain)
        is None
    )


def test_success_criterion_names_its_source():
    found, given = (
        make("CartPole-v1", Settings(success_return=x)).demonstrations.criterion
        for x in (None, 3.0)
    )
    assert "475 (reward_threshold of the environment, meant" in str(found)
    assert str(given) == "a return of at least 3 (given)"


@pytest.mark.parametrize(
    ("level", "text"),
    [
        ("CartPol-v1", "no 'CartPol-v1' is registered; .* MODULE:CartPol-v1; did you .*CartPole"),
        # The error suggests a name only if the name is wrong.
        ("no_such_module:Own-v0", "cannot be made: no module 'no_such_module': install it"),
        ("Pendulum-v1", "has actions Box.*: expected Discrete"),
        ("Endless-v0", "no limit of steps, so an episode may never end"),
        ("ALF/Pong-v5", "no ALF/ is registered: install the package that has it"),
        ("a:b:c", "expected its id, or MODULE:ID"),
        ("Raises-v0", "step of Raises-v0 raised RuntimeError: the lamp"),
        ("Grows-v0", "gave an observation of shape .*its observation space says"),
    ],
)
def test_unusable_environments_raise_one_line_errors(level, text, tmp_path, monkeypatch, capsys):
    with pytest.raises(UserError, match=text) as raised:
        adapter = make(level, Settings()).make_adapter()
        adapter.reset(0)
        adapter.step(1)
    assert ("did you mean" in str(raised.value)) == ("did you" in text)
    monkeypatch.chdir(tmp_path)
    random = "--method random --demos 0 --episodes 2 --no-pictures".split()
    assert program.main(["--env", level, *random]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_program_learns_from_a_data_set_and_plays(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert program.main(["--env=Corridor-v0", *SMALL, "--steps", "1"]) == 2
    assert "Corridor-v0 has no demonstrator: name a Minari data set" in capsys.readouterr().err
    name = recorded("my/corridor-v0", "Corridor-v0", lambda view: 1, 4)
    (chosen,) = command_line.parse("gymnasium", ["--demonstrations", name])
    assert (chosen.level, chosen.demos) == ("Corridor-v0", 4)  # from the data set
    options = [*SMALL, "--horizon", "3", "--context", "1", "--steps", "40"]
    monkeypatch.setattr(
        train, "judge_values", lambda _, data, means: f"{len(data)} of {means['step']}"
    )
    assert program.main(["--dataset", name, *options]) == 0
    (row,) = results.read(tmp_path / "runs" / "gymnasium.jsonl")
    assert row["successes"] == 3 and row["mean_return"] == 1.0 and row["mean_length"] == LENGTH - 1
    assert (row["data_success"], row["data_return"], row["criterion_given"]) == (1.0, 1.0, False)
    output = capsys.readouterr().out
    assert "mean return 1.00 (data: 1.00), success 100.0%" in " ".join(output.split())
    assert "warning: 4 of 40" in output
    assert "success: a positive reward at the end (nobody has named a return)" in output
    assert domains.find_domain("gymnasium") is GYMNASIUM


def test_target_return_defaults_to_a_high_return_of_the_data(tmp_path, monkeypatch, capsys):
    """A given target takes precedence; a checkpoint keeps the target of its data."""
    monkeypatch.chdir(tmp_path)
    name = recorded("my/corridor-v0", "Corridor-v0", lambda view: 1, 2)
    options = [*SMALL, "--dataset", name, "--method", "dt", "--steps", "0"]
    assert program.main(options) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "target return: 1, from the demonstrations" in printed
    assert "return scale: 1, from the demonstrations" in printed
    (folder,) = (tmp_path / "runs").glob("gymnasium-*")
    assert pretrained.load(folder).specification.method_settings.target_return == 1.0
    assert program.main([*options, "--target-return", "7"]) == 0
    assert "target return:" not in capsys.readouterr().out
    assert program.main([*options, "--checkpoint", str(folder)]) == 0
    (*_, row) = results.read(tmp_path / "runs" / "gymnasium.jsonl")
    assert row["configuration"]["method_settings"]["target_return"] == 1.0


def test_data_match_an_environment_given_with_its_module(tmp_path, monkeypatch):
    """Data sets store the environment's id without its module."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    register = 'gym.register("Theirs-v0", "tests.test_gymnasium:Corridor", max_episode_steps=12)'
    (tmp_path / "their_corridor.py").write_text(f"import gymnasium as gym\n{register}\n")
    name = recorded("my/theirs-v0", "their_corridor:Theirs-v0", lambda view: 1, 2)
    options = [*RANDOM, "--demos", "2", "--steps", "0"]
    assert program.main(["--env", "their_corridor:Theirs-v0", "--dataset", name, *options]) == 0


def load_demonstrations(name, level, **options):
    return storage.load(name, make(level, Settings(**options))).demonstrations


def test_data_recorded_with_other_arguments_raise_an_error():
    large = {"map_name": "8x8", "is_slippery": False}
    name = recorded("my/lake-v0", "FrozenLake-v1", lambda view: 2, 2, **large)
    for other in ("{}", '{"is_slippery": false}', '{"map_name": "8x8"}'):
        with pytest.raises(UserError, match="recorded in FrozenLake-v1 with other arg") as raised:
            load_demonstrations(name, "FrozenLake-v1", arguments=other)
        assert f"give it {json.dumps(large)}" in str(raised.value)  # all of them
    assert len(load_demonstrations(name, "FrozenLake-v1", arguments=json.dumps(large))) == 2
    for wrong in ("[]", "{", "[" * 100_000):
        with pytest.raises(ValueError, match="arguments must be a JSON object like"):
            Settings(arguments=wrong)


class Dimmed(gym.ObservationWrapper):
    """A user's wrapper, which does not report its arguments."""

    def observation(self, observation):
        return {**observation, "here": observation["here"] / 2}


class Renamed(Dimmed):
    """A wrapper with another name."""


def test_data_recorded_with_other_wrappers_raise_an_error():
    scaled = recorded(
        "my/scaled-v0", "MountainCar-v0", lambda view: 1, 1,
        lambda env: RescaleObservation(env, -1.0, 1.0),
    )  # fmt: skip
    (found,) = load_demonstrations(scaled, "Scaled-v0")
    adapter = make("Scaled-v0", Settings()).make_adapter()
    np.testing.assert_allclose(adapter.reset(0), found.observations[0], atol=1e-6)
    dimmed = recorded("my/dimmed-v0", "Corridor-v0", lambda view: 1, 1, Dimmed)
    assert len(load_demonstrations(dimmed, "Dim-v0")) == 1
    plain = recorded("my/plain-v0", "MountainCar-v0", lambda view: 1, 1)
    renamed = recorded("my/renamed-v0", "Corridor-v0", lambda view: 1, 1, Renamed)
    sticky = recorded(
        "my/sticky-v0", "MountainCar-v0", lambda view: 1, 1, lambda env: StickyAction(env, 0.25)
    )
    for name, level, text in [
        (plain, "Scaled-v0", "was recorded with no wrappers, and .*RescaleObs"),
        (scaled, "MountainCar-v0", "RescaleObservation .*min_obs.*-1.0"),
        (sticky, "MountainCar-v0", "was recorded with the wrappers StickyAction"),
        (renamed, "Dim-v0", "was recorded with the wrappers .*Renamed"),
        (dimmed, "Corridor-v0", "was recorded with the wrappers .*Dimmed"),
    ]:
        with pytest.raises(UserError, match=text):
            load_demonstrations(name, level)


@pytest.mark.parametrize(
    ("wrap", "text"),
    [
        (lambda env: TransformReward(env, abs), "reward at step 0"),
        (lambda env: TransformObservation(env, lambda x: x[::-1], None), "first observation"),
        (lambda env: TransformAction(env, lambda a: 2 - a, None), "observation after step 0"),
        (RecordEpisodeStatistics, None),  # changes no data
    ],
)
def test_replayed_actions_reveal_unrecorded_wrappers(wrap, text):
    """Minari stores no description of an environment if a wrapper takes a function."""
    name = recorded("my/wrapped-v0", "MountainCar-v0", lambda view: 0, 1, wrap)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        load_demonstrations(name, "MountainCar-v0")
    messages = [str(each.message) for each in warned if "may not have been" in str(each)]
    assert len(messages) == (text is not None)
    assert text is None or f"with its seed 0 has another {text}; look for wrappers" in messages[0]


def test_different_step_limits_need_an_explicit_choice():
    name = recorded("my/short-v0", "Corridor-v0", lambda view: 1, 1, max_episode_steps=7)
    with pytest.raises(UserError, match=r"at most 7 steps, and Corridor-v0 ends them after 12: .*"):
        load_demonstrations(name, "Corridor-v0")
    for chosen in (7, 12, 9):
        assert len(load_demonstrations(name, "Corridor-v0", max_steps=chosen)) == 1


def edit_spaces(name, change):
    """Changes the spaces in a data set's metadata, as if it came from another environment."""
    path = storage.find_datasets_folder() / name / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    spaces = {each: json.loads(metadata[each]) for each in SPACES}
    change(spaces["observation_space"], spaces["action_space"])
    metadata |= {each: json.dumps(space) for each, space in spaces.items()}
    path.write_text(json.dumps(metadata))


LARGEST = float(np.finfo(np.float32).max)  # how older environments write infinity


@pytest.mark.parametrize(
    ("level", "change", "text"),
    [
        ("MountainCar", lambda s, a: s["low"].__setitem__(0, -0.5), "each observation is in Box"),
        ("MountainCar", lambda s, a: a.update(n=4), r"each action is in Discrete\(4\), and"),
        ("MountainCar", lambda s, a: a.update(start=1), "each action is in .*start=1"),
        ("MountainCar", lambda s, a: s["low"].__setitem__(0, -1.2000001), None),  # rounded
        ("MountainCar", lambda s, a: s.update(dtype="float64"), None),
        ("Corridor", lambda s, a: s["subspaces"]["here"].update(high=[LARGEST] * 2), None),
        ("Corridor", lambda s, a: s["subspaces"]["lamp"].update(n=4), "each observation.*lamp"),
    ],
)
def test_data_with_other_spaces_raise_an_error(level, change, text):
    name = recorded("my/car-v0", f"{level}-v0", lambda view: 1, 1)
    edit_spaces(name, change)
    if text is None:
        assert len(load_demonstrations(name, f"{level}-v0")) == 1
    else:
        with pytest.raises(UserError, match=text):
            load_demonstrations(name, f"{level}-v0")


def test_encoder_distinguishes_negative_choices():
    """A one-hot code that starts at 0 would be all zeros for every negative choice."""
    module = StateTokens(parts_of(Deep.observation_space), 8, 0)
    context = blank_context(make("Deep-v0", Settings()), 0)
    params = random_like(jax.eval_shape(module.init, jax.random.key(0), context))
    encode = jax.jit(module.apply)
    levels = [{"below": {"level": np.int64(n), "two": np.array([0, 0])}} for n in range(-2, 3)]
    tokens = [encode(params, context._replace(observation=each))[-1] for each in levels]
    for one, other in itertools.combinations(tokens, 2):
        assert np.abs(one - other).max() > 1e-3
    adapter = make("Deep-v0", Settings()).make_adapter()
    assert adapter.reset(0) == {"below": {"level": -2, "two": pytest.approx([0, -1])}}
    assert adapter.step(1).observation["below"]["level"] == -1


class Moody(gym.Env):
    """Each observation is a different kind of mapping."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict(b=spaces.Discrete(9), a=spaces.Discrete(9))
    kinds = (OrderedDict, dict, types.MappingProxyType, FrozenDict)

    def reset(self, *, seed=None, options=None):
        self.count = seed  # episodes begin with different kinds
        return self.view(), {}

    def view(self):
        self.count += 1
        values = {"b": np.int64(self.count % 9), "a": np.int64(0)}
        return self.kinds[self.count % len(self.kinds)](values)

    def step(self, action):
        return self.view(), 1.0, False, self.count > 12, {}


class Bare:
    """A user's adapter, which passes observations on unchanged."""

    num_actions = 3

    def __init__(self, env):
        self.env = env

    def reset(self, seed):
        return self.env.reset(seed=seed)[0]

    def step(self, action):
        return Transition(*self.env.step(action)[:4], success=False)


@pytest.mark.parametrize("adapter", [GymnasiumAdapter, Bare])
def test_rollouts_convert_all_mappings_to_dicts(adapter):
    contexts = []

    class Planner:
        num_actions = 3

        def plan_next(self, params, keys, context, cache):
            contexts.append(context)
            filler = np.zeros(len(keys), np.int32)
            return Plan(filler[:, None], *[filler] * 4), None

    episodes = evaluate(lambda: adapter(Moody()), [1, 2, 3], Planner(), (), context=2)
    assert list(episodes.lengths) == [11, 10, 9]
    assert all(set(each.past) == {"a", "b"} and type(each.past) is dict for each in contexts)
    np.testing.assert_array_equal(contexts[2].past["b"], [[2, 3], [3, 4], [4, 5]])


def test_data_sets_convert_all_mappings_to_dicts():
    blank = {"b": np.zeros((), np.int64), "a": np.zeros(2, np.float32)}
    view = {"b": np.arange(3), "a": np.ones((3, 2), np.float32)}
    rest = np.zeros(2, np.int32), np.zeros(2, np.float32), True, False, storage.UNKNOWN_SEED
    kinds = (dict, OrderedDict, FrozenDict)
    given = [Demonstration(kind(view), *rest) for kind in kinds]
    domains = [toy.DOMAIN._replace(blank=kind(blank)) for kind in kinds]
    storage.save("my/kinds-v0", Collection(given, {}), domains[0], "kinds")
    for domain in domains:
        found = storage.load("my/kinds-v0", domain).demonstrations
        joined = windows.concatenate([*given, *found]).observations
        assert jax.tree.structure(joined) == jax.tree.structure(blank_context(domain, 1).past)
        np.testing.assert_array_equal(joined["b"], [0, 1, 2] * 6)


def test_choices_outside_their_space_raise_an_error():
    several = spaces.Dict(one=spaces.Discrete(3, start=2), more=spaces.MultiDiscrete([2, 4]))
    good = {"one": np.array([2, 4]), "more": np.array([[0, 0], [1, 3]])}
    check_choices(several, good, "it")
    for field, wrong, text in ("one", [1, 4], "1, expected 2"), ("more", [[2, 3]], "2, expected 0"):
        with pytest.raises(UserError, match=f"it: {field}: a choice of {text}"):
            check_choices(several, {**good, field: np.array(wrong)}, "it")


def test_environments_are_closed():
    domain = make("Held-v0", Settings())
    assert (Held.made, Held.closed) == (1, 1)
    domain.make_adapter().close()
    assert (Held.made, Held.closed) == (2, 2)
    with pytest.raises(UserError, match="close of Held-v0 raised OSError: the port is gone"):
        domain.make_adapter().close()
