import functools
import math
import types
from typing import ClassVar

import gymnasium as gym
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from leapjax import rollouts
from leapjax.environments import GymnasiumAdapter, Transition, closing, environments_of
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig
from leapjax.rollouts import History, join
from leapjax.types import Context
from tests.recorder import Recorder

LEFT, RIGHT, END = range(3)
NUM_ACTIONS = 3
HORIZON, ITERATIONS = 4, 5
PAD = NUM_ACTIONS + 1
GOAL, LIMIT = 6, 30
RESULTS = ("seeds", "successes", "lengths", "returns", "plans")


def start(seed):
    return max(seed % 7 - 1, 0)


def distances(seeds):
    return np.array([GOAL - start(seed) for seed in seeds])


class Corridor:
    """Cells 0 .. 6; an episode starts at (seed mod 7) - 1, or at 0; 6 is success, -1 a fall.

    Rewards say nothing of success: a quarter for each cell from 0.
    """

    num_actions = NUM_ACTIONS
    made: ClassVar[list["Corridor"]] = []

    def __init__(self, **changed) -> None:
        """`changed`: what each step returns in place of what it should; `step`: all of it."""
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
def no_corridors():
    Corridor.made = []


def compiled(total, encode=lambda params, context: (), num_actions=NUM_ACTIONS, **options):
    energy = leap.from_total(encode, total, num_actions)
    config = GibbsConfig(HORIZON, ITERATIONS, order="sequential", **options)
    return leap.compile_planner(energy, config, chunk_sizes=(1, 4))


def scripted(script) -> leap.CompiledPlanner:
    """Plans what `script(params, context)` says, an array [T] or one action for all."""

    def total(params, wanted, actions):
        return jnp.sum(actions != wanted).astype(jnp.float32)

    return compiled(total, script)


@functools.cache
def walker() -> leap.CompiledPlanner:
    """As many steps to the right as the parameters say, then the end."""
    return scripted(lambda params, context: jnp.where(jnp.arange(HORIZON) < params, RIGHT, END))


@functools.cache
def stroller() -> leap.CompiledPlanner:
    """Draws left or right at random, right more often; the end sometimes, but not first."""

    def total(params, memory, actions):
        costs = jnp.array([0.6, 0.0, 1.0])[actions]
        return costs.sum() + jnp.where(actions[0] == END, jnp.inf, 0.0)

    return compiled(total, temperature=1.0)


def walk(make=Corridor, seeds=(3,), steps=HORIZON, **options):
    """Episodes of the walker."""
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
def test_history_against_everything_that_happened(length):
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(2, 2)).astype(np.float32) for _ in range(8)]
    actions = rng.integers(0, 3, 7).tolist()
    rewards = (rng.integers(-9, 10, 7) / 4).tolist()
    buffer = {"x": states[0].copy()}  # which the environment writes each state to
    history = History(buffer, length, NUM_ACTIONS)
    contexts = [history.context()]
    for action, state, reward in zip(actions, states[1:], rewards, strict=True):
        buffer["x"][:] = state
        history.advance(action, buffer, reward)
        contexts.append(history.context())
    # Compared at the end, so that a later step that changes an earlier context shows.
    padding = [np.zeros((2, 2))] * length
    for now, context in enumerate(contexts):
        assert context.step == now and context.return_so_far == sum(rewards[:now])
        np.testing.assert_array_equal(context.observation["x"], states[now])
        seen = (context.past["x"], context.actions, context.rewards)
        for found, blank, all_of, kind in zip(
            seen, (padding, [PAD] * length, [0] * length), (states, actions, rewards),
            (np.float32, np.int32, np.float32), strict=True,
        ):  # fmt: skip
            expected = [*blank, *all_of[:now]][now:]
            np.testing.assert_array_equal(found, np.array(expected).reshape(found.shape))
            assert found.dtype == kind and len(found) == length


@pytest.mark.parametrize(("steps", "executed"), [(1, None), (2, 3), (HORIZON, 3), (HORIZON, 1)])
def test_a_plan_is_executed_up_to_its_end_or_as_far_as_asked(steps, executed):
    seeds = [0, 3, 6, 4]
    episodes = walk(seeds=seeds, steps=steps, executed=executed)
    np.testing.assert_array_equal(episodes.seeds, seeds)
    assert episodes.successes.all()
    np.testing.assert_array_equal(episodes.lengths, distances(seeds))
    np.testing.assert_array_equal(episodes.returns, [sum(c.rewards) for c in Corridor.made])
    # Every plan is good for so many steps, and an episode that is over asks for none.
    assert episodes.plans == np.ceil(distances(seeds) / min(steps, executed or HORIZON)).sum()
    assert 0 < episodes.planning_seconds <= episodes.seconds


@pytest.mark.parametrize("iteration", [1, ITERATIONS, None])
def test_the_plan_is_executed_as_it_stood_after_an_iteration(iteration):
    differ = 0
    for seed in (1, 2, 8):
        recorder = Recorder(stroller())
        leap.evaluate(
            Corridor, [seed], recorder, None, context=0, iteration=iteration, executed=3,
            progress=give_up_after(200),
        )  # fmt: skip
        planned = []
        for plans in recorder.plans:
            [trace], [final] = plans.trace, plans.actions
            chosen = trace[-1 if iteration is None else iteration - 1, :3].tolist()
            planned += chosen[: chosen.index(END)] if END in chosen else chosen
            differ += chosen != final[:3].tolist()
        taken = Corridor.made[-1].taken
        assert taken == planned[: len(taken)]
        assert len(planned) - len(taken) < 3  # the episode may be over before its last plan is
    assert (differ > 0) == (iteration == 1)


def test_a_plan_that_is_begun_is_executed_as_far_as_it_goes():
    """Every iteration of beam search chooses one action more; what is not chosen is not done."""

    def logits(params, memory, tokens, positions):  # of LEFT, RIGHT and END: always to the right
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
        np.testing.assert_array_equal(contexts.observation["position"], positions)
        np.testing.assert_array_equal(contexts.step, np.full(len(left), call))
        for back in (1, 2):
            known = call >= back
            past = contexts.past["position"][:, -back]
            np.testing.assert_array_equal(past, positions - back if known else 0 * positions)
            assert (contexts.actions[:, -back] == (RIGHT if known else PAD)).all()
            reward = (positions - back + 1) / 4 if known else 0 * positions
            np.testing.assert_array_equal(contexts.rewards[:, -back], reward)
    over = [int((distances(seeds) <= call).sum()) for call in range(1, GOAL + 1)]
    assert reported == list(zip(over, over, strict=True))


class EagerCorridor(Corridor):
    """A corridor that can be told beforehand where to go."""

    calls: ClassVar[list[tuple[str, int]]] = []

    def begin(self, action: int) -> None:
        self.calls.append(("begin", action))

    def step(self, action: int) -> Transition:
        self.calls.append(("step", action))
        return super().step(action)


def test_first_steps_begin_before_any_is_waited_for():
    EagerCorridor.calls.clear()
    eager, plain = (walk(make, [4, 5, 6], 2) for make in (EagerCorridor, Corridor))
    for field in RESULTS:
        np.testing.assert_array_equal(getattr(eager, field), getattr(plain, field), field)
    calls = EagerCorridor.calls
    assert calls[:3] == [("begin", RIGHT)] * 3 and calls[3][0] == "step"
    # The first action of each plan begins; the second is taken as ever.
    assert [kind for kind, _ in calls].count("begin") == eager.plans
    assert [kind for kind, _ in calls].count("step") == eager.lengths.sum() > eager.plans


def test_an_episode_is_a_success_only_where_the_environment_says_so():
    fallen = leap.evaluate(Corridor, [2, 5], scripted(lambda p, c: LEFT), None, context=0)
    assert not fallen.successes.any()
    np.testing.assert_array_equal(fallen.lengths, [2, 5])
    np.testing.assert_array_equal(fallen.returns, [-0.25, 1.25])  # (0 - 1) / 4, (3+2+1+0-1) / 4
    there_and_back = scripted(
        lambda p, context: jnp.where((context.step + jnp.arange(HORIZON)) % 2 == 0, RIGHT, LEFT)
    )
    late = leap.evaluate(Corridor, [2], there_and_back, None, context=0)
    assert not late.successes.any() and late.lengths == [LIMIT]
    assert late.plans == np.ceil(LIMIT / HORIZON)


class Slippery(Corridor):
    """Goes left, whatever it is asked for, and says so."""

    def step(self, action: int) -> Transition:
        return super().step(LEFT)._replace(taken=LEFT)


def test_a_context_remembers_what_was_executed_and_not_what_was_asked_for():
    plan = scripted(lambda p, context: jnp.where(context.actions[-1] == LEFT, END, RIGHT))
    played = leap.evaluate(Slippery, [5], plan, None, context=1, executed=1)
    assert played.lengths.tolist() == [1]


def test_scores_are_reported_and_rewards_are_seen():
    def left_until_a_reward(params, context: Context):  # the first step to the right gives 3 / 4
        seen = (context.return_so_far == 0.75) & (context.rewards[-1] == 0.75)
        return jnp.where(seen, LEFT, RIGHT)

    episodes = leap.evaluate(
        lambda: Corridor(score=10.0), [3], scripted(left_until_a_reward), None,
        context=1, executed=1, max_steps=2,
    )  # fmt: skip
    assert Corridor.made[-1].taken == [RIGHT, LEFT]
    np.testing.assert_array_equal(episodes.returns, [20.0])


def play(seeds, **options):
    episodes = leap.evaluate(
        Corridor, seeds, stroller(), None, context=1, progress=give_up_after(200), **options
    )
    taken = [adapter.taken for adapter in Corridor.made[-len(seeds) :]]
    assert [len(actions) for actions in taken] == episodes.lengths.tolist()
    return dict(zip(seeds, zip(episodes.successes.tolist(), taken, strict=True), strict=True))


def test_an_episode_is_a_function_of_its_seeds_alone_or_in_any_batch():
    seeds = list(range(20, 29))
    together = play(seeds)
    assert len({str(result) for result in together.values()}) > 4
    for subset in ([20], seeds[::-1], seeds[3:6]):
        assert play(subset) == {seed: together[seed] for seed in subset}
    assert play(seeds, seed=1) == play(seeds, seed=1) != together


def test_episodes_that_were_played_side_by_side():
    first, second, whole = (walk(seeds=seeds, steps=2) for seeds in ([0, 3], [6], [0, 3, 6]))
    joined = join([first, second])
    for field in RESULTS:
        np.testing.assert_array_equal(getattr(joined, field), getattr(whole, field), field)
    assert joined.seconds == max(first.seconds, second.seconds)


def test_plans_that_end_at_once_do_not_go_on_for_ever():
    walk(steps=0, progress=give_up_after(50))


@pytest.mark.parametrize("most", [1, 6])
def test_an_episode_may_be_cut_off(most):
    seeds = np.array([0, 3, 6])
    limits = {"context": np.int8(0), "executed": np.int64(2), "max_steps": np.uint8(most)}
    episodes = walk(seeds=seeds, **limits)
    np.testing.assert_array_equal(episodes.lengths, np.minimum(distances(seeds), most))
    np.testing.assert_array_equal(episodes.successes, distances(seeds) <= most)
    assert episodes.plans == np.ceil(episodes.lengths / 2).sum()


# What enters, and what an environment gives.


class Wider(Corridor):
    num_actions = NUM_ACTIONS + 1


class Growing(Corridor):
    def observe(self):
        return {"position": np.zeros(len(self.taken), np.int32)}


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"executed": 0}, "executed must be at least 1, got 0"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"iteration": 0}, "iteration must be"),
        ({"iteration": ITERATIONS + 1}, "iteration"),
        *(
            ({name: wrong}, f"{name} must be")
            for name in ("context", "executed", "iteration", "max_steps")
            for wrong in (-1, 2.0, True)
        ),
        ({"seeds": []}, "no seeds"),
        ({"seeds": [1, 2**32]}, "level seed must be"),
        ({"seed": -1}, "seed must be"),
        ({"make": functools.cache(Corridor), "seeds": [0, 1]}, "same environment twice"),
        ({"make": Wider}, "planner has 3 actions and the environment 4"),
    ],
)
def test_options_that_would_give_wrong_episodes_are_refused(options, says):
    with pytest.raises(ValueError, match=says):
        walk(**options)
    assert not any(corridor.taken for corridor in Corridor.made)


def observed(position, goal=(0.0,)):
    return {"position": np.array(position), "goal": np.array(goal)}


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"reward": -math.inf}, "reward of -inf"),
        ({"reward": 1e39}, "reward of 1e[+]39"),  # not in the numbers that planners see
        ({"reward": "1"}, "reward of 1 at .*: expected a number"),
        ({"reward": np.ones(1)}, r"reward of \[1\.\]"),
        ({"score": math.nan}, "score of nan"),
        ({"score": np.zeros(2)}, "score of "),
        ({"observation": observed(np.float32(np.nan))}, "observation.*pos"),
        ({"observation": observed(0.0, [np.inf])}, "observation.*go"),
        ({"observation": {"position": np.zeros(())}}, "other shapes"),
        ({"taken": NUM_ACTIONS}, "action taken"),
        ({"taken": 0.5}, "action taken"),
        ({"success": "no"}, "success at .* must be true or false"),
        ({"terminated": None}, "terminated at "),
        ({"truncated": math.nan}, "truncated at "),
        ({"step": (0, 1.0, True, False, {})}, "step of Corridor returned tuple"),
    ],
)
def test_steps_that_no_data_may_have_are_refused(changed, says):
    with pytest.raises(UserError, match=says) as refused:
        walk(lambda: Corridor(**changed), seeds=[7], context=1)
    assert "step" in changed or "step 1 of level seed 7" in str(refused.value)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: gym.make("CartPole-v1"), "returned TimeLimit, expected an Adapter.*Gymnasium"),
        (lambda: Corridor, "returned the class Corridor"),
        (Corridor(), "make_adapter is Corridor: expected a function"),
        (Growing, "observation of other shapes"),
    ],
)
def test_an_environment_of_another_kind_is_named(make, says):
    with pytest.raises(UserError, match=says):
        walk(make)


def test_numbers_and_marks_of_any_type_are_taken():
    for one in (np.float16, np.array, jnp.float32, np.uint8):
        found = walk(lambda one=one: Corridor(reward=one(1), score=one(1), truncated=one(0)))
        assert found.successes.all() and found.returns == found.lengths == GOAL - start(3)


def test_what_a_history_cannot_hold_is_refused():
    with pytest.raises(UserError, match="not finite at step 0 of level seed 3"):
        History((np.zeros(2), np.array([1, np.nan], np.float16)), 0, NUM_ACTIONS, 3)
    history = History(np.zeros(1), 0, NUM_ACTIONS)
    history.advance(0, np.zeros(1), 3e38)
    with pytest.raises(UserError, match="return of 6e[+]38 at step 2:"):
        history.advance(0, np.zeros(1), 3e38)


# What is opened.


class Held(Corridor):
    """Counts how many are open."""

    open: ClassVar[list["Held"]] = []
    most = 0
    fails_at = -1

    def __init__(self) -> None:
        super().__init__()
        self.open.append(self)
        Held.most = max(Held.most, len(self.open))

    def step(self, action: int) -> Transition:
        if len(self.made) == self.fails_at:
            raise StuckError
        return super().step(action)

    def close(self) -> None:
        self.open.remove(self)


@pytest.fixture
def held(monkeypatch):
    monkeypatch.setattr(Held, "open", [])
    monkeypatch.setattr(Held, "most", 0)
    monkeypatch.setattr(rollouts, "MOST_OPEN", 3)
    return Held


def test_few_environments_are_open_at_once_which_changes_nothing(held):
    seeds = [5, 0, 3, 6, 20, 21, 22, 23]
    few, all_at_once = (
        leap.evaluate(make, seeds, stroller(), None, context=1, max_steps=9)
        for make in (held, Corridor)
    )
    assert held.most == 3 and not held.open
    for field in RESULTS:
        np.testing.assert_array_equal(getattr(few, field), getattr(all_at_once, field), field)
    assert len(set(few.lengths.tolist())) > 2


def test_all_is_closed_where_playing_ends_early(held, monkeypatch):
    def interrupt(over, succeeded):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        walk(held, range(9), progress=interrupt)
    assert held.most == 3 and not held.open
    with pytest.raises(UserError, match="same environment twice"):
        walk(functools.cache(held), [0, 1])
    assert not held.open
    monkeypatch.setattr(held, "fails_at", len(Corridor.made) + 4)
    with pytest.raises(StuckError):
        walk(held, range(9), steps=1)
    assert not held.open


class Unclosable(Corridor):
    def close(self) -> None:
        raise OSError("the port is gone")


def test_what_goes_wrong_first_is_what_is_told():
    with pytest.raises(StuckError), closing(Unclosable()):
        raise StuckError
    with pytest.raises(StuckError):
        walk(Unclosable, steps=1, progress=give_up_after(0))


@pytest.mark.parametrize("executed", [1, 2])
def test_a_cache_is_passed_on_within_an_episode_after_plans_of_one_action(executed, monkeypatch):
    monkeypatch.setattr(rollouts, "MOST_OPEN", 2)

    def encode_next(params, context, cache):
        count = 1 if cache is None else cache["plans"] + 1
        return None, {"plans": count, "observation": context.observation}

    def total(params, memory, actions):
        return jnp.sum(actions != RIGHT).astype(jnp.float32)

    energy = leap.from_total(lambda params, context: None, total, NUM_ACTIONS)
    config = GibbsConfig(2, iterations=3, order="sequential")
    recorder = Recorder(leap.compile_planner(energy, config, (1, 4), encode_next=encode_next))
    seeds = [3, 5, 0]  # the second is over first, and the third begins
    episodes = leap.evaluate(Corridor, seeds, recorder, None, context=0, executed=executed)
    np.testing.assert_array_equal(episodes.lengths, distances(seeds))
    for contexts, cache in zip(recorder.contexts, recorder.caches, strict=True):
        if executed == 2:
            assert cache is None
        elif cache is None:
            np.testing.assert_array_equal(contexts.step, 0)
        else:
            np.testing.assert_array_equal(contexts.step, cache["plans"])
            position = cache["observation"]["position"]
            np.testing.assert_array_equal(contexts.observation["position"], position + 1)


# Environments of Gymnasium.


class Line(gym.Env):
    """Gymnasium's view of a corridor: the first action stays, 1 goes on, the last gives up."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float32)

    def __init__(self, action_space: gym.Space | None = None) -> None:
        self.action_space = action_space or gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = int(self.np_random.integers(0, 3))
        self.taken = []
        return np.array([self.position], np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.taken.append(action)
        self.position += action == 1
        arrived = self.position == 4
        reward = 2.0 if arrived else -1.0
        over = bool(arrived or action == 2)
        return np.array([self.position], np.float32), reward, over, len(self.taken) >= 9, {}


def test_any_gymnasium_environment_with_discrete_actions():
    adapter = GymnasiumAdapter(Line())
    assert adapter.num_actions == 4  # the end action is ours
    np.testing.assert_array_equal(adapter.reset(3), adapter.reset(3))
    assert {float(adapter.reset(seed)[0]) for seed in range(20)} == {0.0, 1.0, 2.0}
    adapter.env.position = 3
    assert adapter.step(0)[:5] == (np.array([3]), -1.0, False, False, False)
    assert adapter.step(1)[:5] == (np.array([4]), 2.0, True, False, True)
    adapter.reset(0)
    assert adapter.step(2)[2:5] == (True, False, False)  # given up
    adapter.reset(0)
    assert [adapter.step(0) for _ in range(9)][-1][2:5] == (False, True, False)
    shifted = GymnasiumAdapter(Line(gym.spaces.Discrete(2, start=1)))
    shifted.reset(0)
    assert [shifted.step(0), shifted.step(1)] and shifted.env.taken == [1, 2]


def answering(**answers):
    """An adapter of an environment that answers as it is told."""
    adapter = GymnasiumAdapter(Line())
    adapter.env = types.SimpleNamespace(**{n: lambda *_, a=a, **__: a for n, a in answers.items()})
    return adapter


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: GymnasiumAdapter(Line(gym.spaces.Box(-1, 1, (2,)))), "Discrete action space"),
        (lambda: GymnasiumAdapter(Line(gym.spaces.MultiBinary(2))), "Discrete action space"),
        (lambda: GymnasiumAdapter("CartPole-v1"), "expected a Gymnasium environment"),
        (lambda: answering(reset=np.zeros(1)).reset(0), "old interface"),
        (lambda: answering(step=(0, 1.0, True, {})).step(0), "4 values"),
        (lambda: answering(step=(0, None, 1, 0, {})).step(0), "of None"),
    ],
)
def test_other_environments_are_refused(call, says):
    with pytest.raises((ValueError, TypeError), match=says):
        call()


# What episodes share.

ONE = Line()


class Wrapped:
    """An adapter inside another."""

    __slots__ = ("inner", "reset", "step")
    num_actions = 4

    def __init__(self, inner: GymnasiumAdapter) -> None:
        self.inner = inner
        self.reset, self.step = inner.reset, inner.step


class Late(GymnasiumAdapter):
    """Takes its environment when it is reset."""

    def __init__(self) -> None:
        super().__init__(Line())

    def reset(self, seed: int):
        self.env = ONE
        return super().reset(seed)


@functools.cache
def stayer() -> leap.CompiledPlanner:
    """Stays where it is, in a `Line`."""
    return compiled(lambda p, m, actions: actions.sum().astype(jnp.float32), num_actions=4)


@pytest.mark.parametrize(
    "make",
    [
        lambda: GymnasiumAdapter(gym.wrappers.OrderEnforcing(gym.wrappers.TimeLimit(ONE, 5))),
        lambda: Wrapped(GymnasiumAdapter(ONE)),
        Late,
    ],
)
def test_one_environment_in_two_adapters_is_found(make):
    with pytest.raises(UserError, match="same environment twice"):
        leap.evaluate(make, [0, 1], stayer(), None, context=0)
    assert leap.evaluate(make, [0], stayer(), None, context=0, max_steps=4).lengths == [4]


def test_a_list_of_environments_is_not_searched():
    listed = Corridor()
    listed.pool = [GymnasiumAdapter(ONE)]
    assert environments_of(listed) == []
