import functools
import math
import types
from decimal import Decimal
from typing import ClassVar

import gymnasium as gym
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from leapjax import rollouts
from leapjax.environments import GymnasiumAdapter, Transition
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig
from leapjax.rollouts import History
from leapjax.types import Context
from tests.recorder import Recorder

LEFT, RIGHT, END = range(3)
NUM_ACTIONS = 3
HORIZON, ITERATIONS = 4, 5
PAD = NUM_ACTIONS + 1
GOAL, LIMIT = 6, 30
assert_equal = np.testing.assert_array_equal


def assert_same_episodes(found, expected):
    """Compares all fields but the durations."""
    for field in ("seeds", "successes", "lengths", "returns", "plans"):
        assert_equal(getattr(found, field), getattr(expected, field), field)


def start(seed):
    return max(seed % 7 - 1, 0)


def distances(seeds):
    return np.array([GOAL - start(seed) for seed in seeds])


class Corridor:
    """Cells 0 .. 6: 6 is success, and -1 a fall. `start` gives the first cell of a seed.

    The reward is a quarter of the cell's number, and does not depend on success.
    """

    num_actions = NUM_ACTIONS
    made: ClassVar[list["Corridor"]] = []

    def __init__(self, **changed) -> None:
        """`changed` replaces fields of each transition; `step` replaces the whole transition."""
        self.taken: list[int] = []
        self.rewards: list[float] = []
        self.changed = changed
        Corridor.made.append(self)

    def reset(self, seed: int):
        self.position = start(seed)
        return self.observe()

    def observe(self):
        return {"position": np.array(self.position, np.int32), "goal": np.array([GOAL], np.int32)}

    def step(self, action: int) -> Transition:
        assert action in (LEFT, RIGHT)
        assert self.position not in (-1, GOAL), "stepped after the end"
        self.taken.append(action)
        self.position += 1 if action == RIGHT else -1
        over = self.position in (-1, GOAL)
        success = self.position == GOAL
        self.rewards.append(self.position / 4)
        truncated = not over and len(self.taken) >= LIMIT
        if "step" in self.changed:
            return self.changed["step"]
        found = Transition(self.observe(), self.rewards[-1], over, truncated, success)
        return found._replace(**self.changed)


@pytest.fixture(autouse=True)
def reset_corridors():
    Corridor.made = []


def make_planner(total, encode=lambda params, context: (), num_actions=NUM_ACTIONS, **options):
    energy = leap.from_total(encode, total, num_actions)
    config = GibbsConfig(HORIZON, ITERATIONS, order="sequential", **options)
    return leap.compile_planner(energy, config, chunk_sizes=(1, 4))


def plan_script(script) -> leap.CompiledPlanner:
    """Plans the actions `script(params, context)`: an array [T], or one for all positions."""

    def total(params, target, actions):
        return jnp.sum(actions != target).astype(jnp.float32)

    return make_planner(total, script)


@functools.cache
def walker() -> leap.CompiledPlanner:
    """Plans `params` steps to the right, then the end."""
    return plan_script(lambda params, context: jnp.where(jnp.arange(HORIZON) < params, RIGHT, END))


@functools.cache
def random_walker() -> leap.CompiledPlanner:
    """Plans random actions: most often right, less often left, rarely the end, never first."""

    def total(params, memory, actions):
        costs = jnp.array([0.6, 0.0, 1.0])[actions]
        return costs.sum() + jnp.where(actions[0] == END, jnp.inf, 0.0)

    return make_planner(total, temperature=1.0)


def walk(make=Corridor, seeds=(3,), steps=HORIZON, **options):
    """Plays episodes of the walker."""
    return leap.evaluate(make, seeds, walker(), jnp.int32(steps), **{"context": 0, **options})


class StuckError(Exception):
    pass


def give_up_after(rounds: int):
    calls = []

    def progress(over: int, succeeded: int) -> None:
        calls.append(over)
        if len(calls) > rounds:
            raise StuckError

    return progress


@pytest.mark.parametrize("length", [0, 3])
def test_history_returns_the_last_steps_of_an_episode(length):
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(2, 2)).astype(np.float32) for _ in range(8)]
    actions = rng.integers(0, 3, 7).tolist()
    rewards = (rng.integers(-9, 10, 7) / 4).tolist()
    buffer = {"x": states[0].copy()}  # the environment writes every state into this array
    history = History(buffer, length, NUM_ACTIONS)
    contexts = [history.context()]
    for action, state, reward in zip(actions, states[1:], rewards, strict=True):
        buffer["x"][:] = state
        history.advance(action, buffer, reward)
        contexts.append(history.context())
    # Compares at the end, to detect later steps that change earlier contexts.
    padding = [np.zeros((2, 2))] * length
    for now, context in enumerate(contexts):
        assert context.step == now and context.return_so_far == sum(rewards[:now])
        assert_equal(context.observation["x"], states[now])
        observed = (context.past["x"], context.actions, context.rewards)
        for found, blank, all_of, kind in zip(
            observed, (padding, [PAD] * length, [0] * length), (states, actions, rewards),
            (np.float32, np.int32, np.float32), strict=True,
        ):  # fmt: skip
            expected = [*blank, *all_of[:now]][now:]
            assert_equal(found, np.array(expected).reshape(found.shape))
            assert found.dtype == kind and len(found) == length


@pytest.mark.parametrize("reward", [np.float16(0.1), Decimal("0.1"), np.array(0.1)])
def test_history_sums_rewards_of_any_type_in_double_precision(reward):
    history = History(np.zeros(1), 1, NUM_ACTIONS)
    for _ in range(1000):
        history.advance(0, np.zeros(1), reward)
    assert history.return_so_far == pytest.approx(1000 * float(reward), abs=1e-9)
    assert history.context().rewards == np.float32(reward)


@pytest.mark.parametrize(("steps", "executed"), [(1, None), (2, 3), (HORIZON, 3), (HORIZON, 1)])
def test_plans_are_executed_up_to_their_end_or_the_limit(steps, executed):
    seeds = [0, 3, 6, 4]
    episodes = walk(seeds=seeds, steps=steps, executed=executed)
    assert_equal(episodes.seeds, seeds)
    assert episodes.successes.all()
    assert_equal(episodes.lengths, distances(seeds))
    assert_equal(episodes.returns, [sum(c.rewards) for c in Corridor.made])
    # A plan serves as many steps as it executes, and a finished episode needs no plan.
    assert episodes.plans == np.ceil(distances(seeds) / min(steps, executed or HORIZON)).sum()
    assert 0 < episodes.planning_seconds <= episodes.seconds


@pytest.mark.parametrize("iteration", [1, ITERATIONS, None])
def test_iteration_selects_the_plan_to_execute(iteration):
    changes = 0
    for seed in (1, 2, 8):
        recorder = Recorder(random_walker())
        leap.evaluate(
            Corridor, [seed], recorder, None, context=0, iteration=iteration, executed=3,
            progress=give_up_after(200),
        )  # fmt: skip
        planned = []
        for plans in recorder.plans:
            [trace], [final] = plans.trace, plans.actions
            chosen = trace[-1 if iteration is None else iteration - 1, :3].tolist()
            planned += chosen[: chosen.index(END)] if END in chosen else chosen
            changes += chosen != final[:3].tolist()
        taken = Corridor.made[-1].taken
        assert taken == planned[: len(taken)]
        assert len(planned) - len(taken) < 3  # the episode may end during its last plan
    assert (changes > 0) == (iteration == 1)


def test_partial_plans_are_executed_up_to_their_first_mask():
    """Iteration n of beam search chooses the first n actions; the others are masked."""

    def logits(params, memory, tokens, positions):  # for LEFT, RIGHT and END: always right
        return jnp.tile(-jnp.array([1.0, 0.0, jnp.inf]), (positions.shape[0], 1))

    energy = leap.autoregressive(lambda params, context: (), logits, NUM_ACTIONS)
    plan = leap.compile_planner(energy, leap.BeamConfig(HORIZON, beams=2))
    for iteration in range(1, HORIZON + 1):
        episodes = leap.evaluate(Corridor, [1], plan, None, context=0, iteration=iteration)
        assert episodes.successes.all() and Corridor.made[-1].taken == [RIGHT] * GOAL
        assert episodes.plans == -(-GOAL // iteration)


def test_finished_episodes_leave_the_batch():
    seeds, reported, recorder = [0, 6, 3, 4], [], Recorder(walker())
    leap.evaluate(
        Corridor, seeds, recorder, jnp.int32(1), context=2,
        progress=lambda *numbers: reported.append(numbers),
    )  # fmt: skip
    assert len(recorder.contexts) == max(distances(seeds))
    for call, contexts in enumerate(recorder.contexts):
        left = np.array(seeds)[distances(seeds) > call]
        positions = np.array([start(seed) + call for seed in left])
        assert_equal(contexts.observation["position"], positions)
        assert_equal(contexts.step, np.full(len(left), call))
        for back in (1, 2):
            known = call >= back
            past = contexts.past["position"][:, -back]
            assert_equal(past, positions - back if known else 0 * positions)
            assert (contexts.actions[:, -back] == (RIGHT if known else PAD)).all()
            reward = (positions - back + 1) / 4 if known else 0 * positions
            assert_equal(contexts.rewards[:, -back], reward)
    over = [int((distances(seeds) <= call).sum()) for call in range(1, GOAL + 1)]
    assert reported == list(zip(over, over, strict=True))


class Eager(Corridor):
    """A corridor whose steps can begin in the background."""

    calls: ClassVar[list[tuple[str, int]]] = []

    def begin(self, action: int) -> None:
        self.calls.append(("begin", action))

    def step(self, action: int) -> Transition:
        self.calls.append(("step", action))
        return super().step(action)


def test_first_steps_begin_before_the_rollout_waits():
    eager = walk(Eager, [4, 5, 6], 2)
    assert_same_episodes(eager, walk(Corridor, [4, 5, 6], 2))
    # Only the first action of each plan begins early.
    step = ("step", RIGHT)
    assert Eager.calls[:7] == [("begin", RIGHT)] * 3 + [step, step, step, step]
    begun = [kind for kind, _ in Eager.calls].count("begin")
    assert begun == eager.plans and len(Eager.calls) - begun == eager.lengths.sum()


def test_only_the_environment_decides_on_success():
    fallen = leap.evaluate(Corridor, [2, 5], plan_script(lambda p, c: LEFT), None, context=0)
    assert not fallen.successes.any()
    assert_equal(fallen.lengths, [2, 5])
    assert_equal(fallen.returns, [-0.25, 1.25])  # (0 - 1) / 4, (3+2+1+0-1) / 4
    there_and_back = plan_script(
        lambda p, context: jnp.where((context.step + jnp.arange(HORIZON)) % 2 == 0, RIGHT, LEFT)
    )
    late = leap.evaluate(Corridor, [2], there_and_back, None, context=0)
    assert not late.successes.any() and late.lengths == [LIMIT]
    assert late.plans == np.ceil(LIMIT / HORIZON)


class Slippery(Corridor):
    """Goes left for every action, and reports this."""

    def step(self, action: int) -> Transition:
        return super().step(LEFT)._replace(taken=LEFT)


def test_contexts_hold_the_executed_actions():
    plan = plan_script(lambda p, context: jnp.where(context.actions[-1] == LEFT, END, RIGHT))
    played = leap.evaluate(Slippery, [5], plan, None, context=1, executed=1)
    assert played.lengths.tolist() == [1]


def test_episodes_report_scores_and_planners_see_rewards():
    def left_until_a_reward(params, context: Context):  # the first step to the right gives 3 / 4
        observed = (context.return_so_far == 0.75) & (context.rewards[-1] == 0.75)
        return jnp.where(observed, LEFT, RIGHT)

    episodes = leap.evaluate(
        lambda: Corridor(score=10.0), [3], plan_script(left_until_a_reward), None,
        context=1, executed=1, max_steps=2,
    )  # fmt: skip
    assert Corridor.made[-1].taken == [RIGHT, LEFT]
    assert_equal(episodes.returns, [20.0])


def play_seeds(seeds, **options):
    episodes = leap.evaluate(
        Corridor, seeds, random_walker(), None, context=1, progress=give_up_after(200), **options
    )
    taken = [adapter.taken for adapter in Corridor.made[-len(seeds) :]]
    assert [len(actions) for actions in taken] == episodes.lengths.tolist()
    return dict(zip(seeds, zip(episodes.successes.tolist(), taken, strict=True), strict=True))


def test_episodes_depend_only_on_their_seeds_in_any_batch():
    seeds = list(range(20, 29))
    together = play_seeds(seeds)
    assert len({str(result) for result in together.values()}) > 4
    for subset in ([20], seeds[::-1], seeds[3:6]):
        assert play_seeds(subset) == {seed: together[seed] for seed in subset}
    assert play_seeds(seeds, seed=1) == play_seeds(seeds, seed=1) != together


def test_plans_that_start_with_the_end_finish_the_episode():
    walk(steps=0, progress=give_up_after(50))


def test_the_last_step_decides_on_success_if_the_planner_gives_up():
    """Gives up before any step, at the success in cell 3, and after going past it."""

    class Passing(Corridor):
        def step(self, action):
            found = super().step(action)
            return found._replace(success=self.position == 3)

    plan = plan_script(
        lambda steps, context: jnp.where(context.step + jnp.arange(HORIZON) < steps, RIGHT, END)
    )
    for steps, success in ((0, False), (1, True), (2, False)):
        played = leap.evaluate(Passing, [3], plan, jnp.int32(steps), context=0)
        assert (played.lengths.tolist(), played.successes.tolist()) == ([steps], [success])


@pytest.mark.parametrize("most", [1, 6])
def test_max_steps_cuts_episodes_off(most):
    seeds = np.array([0, 3, 6])
    limits = {"context": np.int8(0), "executed": np.int64(2), "max_steps": np.uint8(most)}
    episodes = walk(seeds=seeds, **limits)
    assert_equal(episodes.lengths, np.minimum(distances(seeds), most))
    assert_equal(episodes.successes, distances(seeds) <= most)
    assert episodes.plans == np.ceil(episodes.lengths / 2).sum()


# Checks of options and environments.


class Wider(Corridor):
    num_actions = NUM_ACTIONS + 1


class Growing(Corridor):
    def observe(self):
        return {"position": np.zeros(len(self.taken), np.int32)}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"iteration": ITERATIONS + 1}, "iteration"),
        ({"context": -1}, "context must be"),
        *(({x: 0}, f"{x} must be at least 1") for x in ("executed", "max_steps", "iteration")),
        ({"seeds": []}, "no seeds"),
        ({"seeds": [1, 2**32]}, "level seed must be"),
        ({"seed": -1}, "seed must be"),
        ({"make": functools.cache(Corridor), "seeds": [0, 1]}, "same environment twice"),
        ({"make": Wider}, "planner has 3 actions and the environment 4"),
    ],
)
def test_invalid_options_raise_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        walk(**options)
    assert not any(corridor.taken for corridor in Corridor.made)


def make_observation(position, goal=(0.0,)):
    return {"position": np.array(position), "goal": np.array(goal)}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"reward": -math.inf}, "reward of -inf"),
        ({"reward": 1e39}, "reward of 1e[+]39"),  # exceeds float32
        ({"reward": 3e38}, "return of 6e[+]38"),
        ({"reward": "1"}, "reward of 1 at .*: expected a number"),
        ({"score": math.nan}, "score of nan"),
        ({"observation": make_observation(np.float32(np.nan))}, "observation.*pos"),
        ({"observation": make_observation(0.0, [np.inf])}, "observation.*go"),
        ({"observation": {"position": np.zeros(())}}, "other shapes"),
        ({"taken": NUM_ACTIONS}, "action taken"),
        ({"success": "no"}, "success at .* must be true or false"),
        ({"terminated": None}, "terminated at "),
        ({"step": (0, 1.0, True, False, {})}, "step of Corridor returned tuple"),
    ],
)
def test_invalid_transitions_raise_an_error(changed, message):
    with pytest.raises(UserError, match=message) as raised:
        walk(lambda: Corridor(**changed), seeds=[7], context=1)
    assert "step" in changed or " of level seed 7" in str(raised.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gym.make("CartPole-v1"), "returned TimeLimit, expected an Adapter.*Gymnasium"),
        (lambda: Corridor, "returned the class Corridor"),
        (Corridor(), "make_adapter is Corridor: expected a function"),
        (Growing, "observation of other shapes"),
    ],
)
def test_invalid_environments_are_named_in_the_error(make, message):
    with pytest.raises(UserError, match=message):
        walk(make)


def test_a_planner_without_a_compiled_plan_raises_an_error():
    with pytest.raises(UserError, match="plan is object: expected a compiled planner, such as"):
        leap.evaluate(Corridor, [1], object(), None, context=0)


def test_numbers_and_flags_of_any_type_are_accepted():
    for cast in (np.float16, np.array, jnp.float32, np.uint8):
        found = walk(lambda cast=cast: Corridor(reward=cast(1), score=cast(1), truncated=cast(0)))
        assert found.successes.all() and found.returns == found.lengths == GOAL - start(3)


# Open environments.


class Closable(Corridor):
    """Counts the open environments."""

    open: ClassVar[list["Closable"]] = []
    most = 0
    fails_at = -1

    def __init__(self) -> None:
        super().__init__()
        self.open.append(self)
        Closable.most = max(Closable.most, len(self.open))

    def step(self, action: int) -> Transition:
        if len(self.made) == self.fails_at:
            raise StuckError
        return super().step(action)

    def close(self) -> None:
        self.open.remove(self)


@pytest.fixture
def closable(monkeypatch):
    monkeypatch.setattr(Closable, "open", [])
    monkeypatch.setattr(Closable, "most", 0)
    monkeypatch.setattr(rollouts, "MOST_OPEN", 3)
    return Closable


def test_limit_of_open_environments_does_not_change_episodes(closable):
    seeds = [5, 0, 3, 6, 20, 21, 22, 23]
    few, all_at_once = (
        leap.evaluate(make, seeds, random_walker(), None, context=1, max_steps=9)
        for make in (closable, Corridor)
    )
    assert closable.most == 3 and not closable.open
    assert_same_episodes(few, all_at_once)
    assert len(set(few.lengths.tolist())) > 2


def test_environments_are_closed_if_the_rollout_ends_early(closable, monkeypatch):
    def interrupt(over, succeeded):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        walk(closable, range(9), progress=interrupt)
    assert closable.most == 3 and not closable.open
    with pytest.raises(UserError, match="same environment twice"):
        walk(functools.cache(closable), [0, 1])
    assert not closable.open
    monkeypatch.setattr(closable, "fails_at", len(Corridor.made) + 4)
    with pytest.raises(StuckError):
        walk(closable, range(9), steps=1)
    assert not closable.open


class Unclosable(Corridor):
    def close(self) -> None:
        raise OSError("the port is gone")


def test_errors_of_close_do_not_hide_the_first_error():
    with pytest.raises(StuckError):
        walk(Unclosable, steps=1, progress=give_up_after(0))


@pytest.mark.parametrize("executed", [1, 2])
def test_caches_are_passed_on_only_after_plans_of_one_action(executed, monkeypatch):
    monkeypatch.setattr(rollouts, "MOST_OPEN", 2)

    def encode_next(params, context, cache):
        count = 1 if cache is None else cache["plans"] + 1
        return None, {"plans": count, "observation": context.observation}

    def total(params, memory, actions):
        return jnp.sum(actions != RIGHT).astype(jnp.float32)

    energy = leap.from_total(lambda params, context: None, total, NUM_ACTIONS)
    config = GibbsConfig(2, iterations=3, order="sequential")
    recorder = Recorder(leap.compile_planner(energy, config, (1, 4), encode_next=encode_next))
    seeds = [3, 5, 0]  # the second ends first, then the third begins
    episodes = leap.evaluate(Corridor, seeds, recorder, None, context=0, executed=executed)
    assert_equal(episodes.lengths, distances(seeds))
    for contexts, cache in zip(recorder.contexts, recorder.caches, strict=True):
        if executed == 2:
            assert cache is None
        elif cache is None:
            assert_equal(contexts.step, 0)
        else:
            assert_equal(contexts.step, cache["plans"])
            position = cache["observation"]["position"]
            assert_equal(contexts.observation["position"], position + 1)


# Gymnasium environments.

DOWN, WALK = 1, [1, 1, 2, 2, 1, 2]  # in FrozenLake; WALK leads to the goal
LAKE = gym.make("FrozenLake-v1", is_slippery=False)


def test_gymnasium_adapter_reports_transitions_and_success():
    adapter = GymnasiumAdapter(LAKE)
    assert adapter.num_actions == 5  # four directions and the end action

    def take_actions(actions):
        assert adapter.reset(3) == 0
        return [adapter.step(action) for action in actions][-1][:5]

    assert take_actions([DOWN]) == (4, 0.0, False, False, False)
    assert take_actions(WALK) == (15, 1.0, True, False, True)
    assert take_actions([DOWN, DOWN, DOWN]) == (12, 0.0, True, False, False)  # a hole
    assert take_actions([0] * 100) == (0, 0.0, False, True, False)
    shifted = types.SimpleNamespace(
        action_space=gym.spaces.Discrete(2, start=1), spec=None,
        step=lambda action: (action, 0.0, False, False, {}),
    )  # fmt: skip
    assert GymnasiumAdapter(shifted).step(0).observation == 1


def make_stub(**returned):
    """Makes an adapter of an environment whose methods return the given values."""
    adapter = GymnasiumAdapter(LAKE)
    adapter.env = types.SimpleNamespace(**{n: lambda *_, a=a, **__: a for n, a in returned.items()})
    return adapter


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: GymnasiumAdapter(gym.make("Pendulum-v1")), "Discrete action space"),
        (lambda: GymnasiumAdapter("CartPole-v1"), "expected a Gymnasium environment"),
        (lambda: make_stub(reset=np.zeros(1)).reset(0), "old interface"),
        (lambda: make_stub(step=(0, 1.0, True, {})).step(0), "4 values"),
        (lambda: make_stub(step=(0, None, 1, 0, {})).step(0), "of None"),
    ],
)
def test_gymnasium_adapter_rejects_other_environments(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()


class Wrapped:
    """An adapter inside another."""

    __slots__ = ("inner", "reset", "step")
    num_actions = 5

    def __init__(self, inner: GymnasiumAdapter) -> None:
        self.inner = inner
        self.reset, self.step = inner.reset, inner.step


@pytest.mark.parametrize(
    "make",
    [
        lambda: GymnasiumAdapter(gym.wrappers.TimeLimit(LAKE, 5)),
        lambda: Wrapped(GymnasiumAdapter(LAKE)),
    ],
)
def test_one_environment_in_two_adapters_raises_an_error(make):
    left = make_planner(lambda p, m, actions: actions.sum().astype(jnp.float32), num_actions=5)
    with pytest.raises(UserError, match="same environment twice"):
        leap.evaluate(make, [0, 1], left, None, context=0)
    assert leap.evaluate(make, [0], left, None, context=0, max_steps=4).lengths == [4]
