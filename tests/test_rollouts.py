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
from leapjax.environments import GymnasiumAdapter, Transition
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
assert_equal = np.testing.assert_array_equal


def assert_same(found, expected):
    """Of episodes: all but how long they took."""
    for field in ("seeds", "successes", "lengths", "returns", "plans"):
        assert_equal(getattr(found, field), getattr(expected, field), field)


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
        assert_equal(context.observation["x"], states[now])
        seen = (context.past["x"], context.actions, context.rewards)
        for found, blank, all_of, kind in zip(
            seen, (padding, [PAD] * length, [0] * length), (states, actions, rewards),
            (np.float32, np.int32, np.float32), strict=True,
        ):  # fmt: skip
            expected = [*blank, *all_of[:now]][now:]
            assert_equal(found, np.array(expected).reshape(found.shape))
            assert found.dtype == kind and len(found) == length


@pytest.mark.parametrize(("steps", "executed"), [(1, None), (2, 3), (HORIZON, 3), (HORIZON, 1)])
def test_a_plan_is_executed_up_to_its_end_or_as_far_as_asked(steps, executed):
    seeds = [0, 3, 6, 4]
    episodes = walk(seeds=seeds, steps=steps, executed=executed)
    assert_equal(episodes.seeds, seeds)
    assert episodes.successes.all()
    assert_equal(episodes.lengths, distances(seeds))
    assert_equal(episodes.returns, [sum(c.rewards) for c in Corridor.made])
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
    """A corridor that can be told beforehand where to go."""

    calls: ClassVar[list[tuple[str, int]]] = []

    def begin(self, action: int) -> None:
        self.calls.append(("begin", action))

    def step(self, action: int) -> Transition:
        self.calls.append(("step", action))
        return super().step(action)


def test_first_steps_begin_before_any_is_waited_for():
    eager = walk(Eager, [4, 5, 6], 2)
    assert_same(eager, walk(Corridor, [4, 5, 6], 2))
    # The first action of each plan begins; the second is taken as ever.
    step = ("step", RIGHT)
    assert Eager.calls[:7] == [("begin", RIGHT)] * 3 + [step, step, step, step]
    begun = [kind for kind, _ in Eager.calls].count("begin")
    assert begun == eager.plans and len(Eager.calls) - begun == eager.lengths.sum()


def test_an_episode_is_a_success_only_where_the_environment_says_so():
    fallen = leap.evaluate(Corridor, [2, 5], scripted(lambda p, c: LEFT), None, context=0)
    assert not fallen.successes.any()
    assert_equal(fallen.lengths, [2, 5])
    assert_equal(fallen.returns, [-0.25, 1.25])  # (0 - 1) / 4, (3+2+1+0-1) / 4
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
    assert_equal(episodes.returns, [20.0])


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
    assert_same(joined, whole)
    assert joined.seconds == max(first.seconds, second.seconds)


def test_plans_that_end_at_once_do_not_go_on_for_ever():
    walk(steps=0, progress=give_up_after(50))


@pytest.mark.parametrize("most", [1, 6])
def test_an_episode_may_be_cut_off(most):
    seeds = np.array([0, 3, 6])
    limits = {"context": np.int8(0), "executed": np.int64(2), "max_steps": np.uint8(most)}
    episodes = walk(seeds=seeds, **limits)
    assert_equal(episodes.lengths, np.minimum(distances(seeds), most))
    assert_equal(episodes.successes, distances(seeds) <= most)
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
        ({"reward": 3e38}, "return of 6e[+]38"),
        ({"reward": "1"}, "reward of 1 at .*: expected a number"),
        ({"score": math.nan}, "score of nan"),
        ({"observation": observed(np.float32(np.nan))}, "observation.*pos"),
        ({"observation": observed(0.0, [np.inf])}, "observation.*go"),
        ({"observation": {"position": np.zeros(())}}, "other shapes"),
        ({"taken": NUM_ACTIONS}, "action taken"),
        ({"success": "no"}, "success at .* must be true or false"),
        ({"terminated": None}, "terminated at "),
        ({"step": (0, 1.0, True, False, {})}, "step of Corridor returned tuple"),
    ],
)
def test_steps_that_no_data_may_have_are_refused(changed, says):
    with pytest.raises(UserError, match=says) as refused:
        walk(lambda: Corridor(**changed), seeds=[7], context=1)
    assert "step" in changed or " of level seed 7" in str(refused.value)


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
    assert_same(few, all_at_once)
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


# Environments of Gymnasium.

DOWN, WALK = 1, [1, 1, 2, 2, 1, 2]  # of FrozenLake: the way to the goal
ONE = gym.make("FrozenLake-v1", is_slippery=False)


def test_any_gymnasium_environment_with_discrete_actions():
    adapter = GymnasiumAdapter(ONE)
    assert adapter.num_actions == 5  # the end action is ours

    def last(actions):
        assert adapter.reset(3) == 0
        return [adapter.step(action) for action in actions][-1][:5]

    assert last([DOWN]) == (4, 0.0, False, False, False)
    assert last(WALK) == (15, 1.0, True, False, True)
    assert last([DOWN, DOWN, DOWN]) == (12, 0.0, True, False, False)  # a hole
    assert last([0] * 100) == (0, 0.0, False, True, False)
    shifted = types.SimpleNamespace(
        action_space=gym.spaces.Discrete(2, start=1), spec=None,
        step=lambda action: (action, 0.0, False, False, {}),
    )  # fmt: skip
    assert GymnasiumAdapter(shifted).step(0).observation == 1


def answering(**answers):
    """An adapter of an environment that answers as it is told."""
    adapter = GymnasiumAdapter(ONE)
    adapter.env = types.SimpleNamespace(**{n: lambda *_, a=a, **__: a for n, a in answers.items()})
    return adapter


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: GymnasiumAdapter(gym.make("Pendulum-v1")), "Discrete action space"),
        (lambda: GymnasiumAdapter("CartPole-v1"), "expected a Gymnasium environment"),
        (lambda: answering(reset=np.zeros(1)).reset(0), "old interface"),
        (lambda: answering(step=(0, 1.0, True, {})).step(0), "4 values"),
        (lambda: answering(step=(0, None, 1, 0, {})).step(0), "of None"),
    ],
)
def test_other_environments_are_refused(call, says):
    with pytest.raises((ValueError, TypeError), match=says):
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
        lambda: GymnasiumAdapter(gym.wrappers.TimeLimit(ONE, 5)),
        lambda: Wrapped(GymnasiumAdapter(ONE)),
    ],
)
def test_one_environment_in_two_adapters_is_found(make):
    left = compiled(lambda p, m, actions: actions.sum().astype(jnp.float32), num_actions=5)
    with pytest.raises(UserError, match="same environment twice"):
        leap.evaluate(make, [0, 1], left, None, context=0)
    assert leap.evaluate(make, [0], left, None, context=0, max_steps=4).lengths == [4]
