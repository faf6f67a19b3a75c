import functools
import math
import types
from typing import ClassVar

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from leapjax import rollouts
from leapjax.environments import GymnasiumAdapter, Transition, closing, environments_of
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig
from leapjax.rollouts import History, join, stack_contexts
from leapjax.types import Context
from tests.recorder import Recorder

LEFT, RIGHT, END = range(3)
NUM_ACTIONS = 3
HORIZON, ITERATIONS = 4, 5
PAD = NUM_ACTIONS + 1
GOAL, LIMIT = 6, 30


class Corridor:
    """Cells 0 .. 6; an episode starts at (seed mod 7) - 1, or at 0; 6 is success, -1 a fall.

    Rewards say nothing of success: a quarter for each cell from 0.
    """

    num_actions = NUM_ACTIONS
    made: ClassVar[list["Corridor"]] = []

    def __init__(self) -> None:
        self.taken: list[int] = []
        self.rewards: list[float] = []
        Corridor.made.append(self)

    def reset(self, seed: int):
        self.position = max(seed % 7 - 1, 0)
        self.steps = 0
        return self.observe()

    def observe(self):
        return {"position": np.array(self.position, np.int32), "goal": np.array([GOAL], np.int32)}

    def step(self, action: int) -> Transition:
        assert action in (LEFT, RIGHT)
        assert self.position not in (-1, GOAL), "stepped after the end"
        self.taken.append(action)
        self.position += 1 if action == RIGHT else -1
        self.steps += 1
        over = self.position in (-1, GOAL)
        success = self.position == GOAL
        self.rewards.append(self.position / 4)
        truncated = not over and self.steps >= LIMIT
        return Transition(self.observe(), self.rewards[-1], over, truncated, success)


@pytest.fixture(autouse=True)
def no_corridors():
    Corridor.made = []


def scripted_energy(script) -> leap.Energy:
    """The energy of a plan is how many of its actions differ from `script(params, context)`."""

    def encode(params, context: Context):
        return script(params, context)

    def total(params, wanted, actions):
        return jnp.sum(actions != wanted).astype(jnp.float32)

    return leap.from_total(encode, total, NUM_ACTIONS)


def compiled(energy: leap.Energy, **options) -> leap.CompiledPlanner:
    config = GibbsConfig(HORIZON, ITERATIONS, order="sequential", **options)
    return leap.compile_planner(energy, config, chunk_sizes=(1, 4))


def steps_then_end(params, context: Context):
    """As many steps to the right as `params` says, then end."""
    return jnp.where(jnp.arange(HORIZON) < params, RIGHT, END)


@functools.cache
def walker() -> leap.CompiledPlanner:
    return compiled(scripted_energy(steps_then_end))


@functools.cache
def stroller() -> leap.CompiledPlanner:
    """Draws left or right at random, right more often; the end sometimes, but not first."""

    def total(params, memory, actions):
        costs = jnp.array([0.6, 0.0, 1.0])[actions]
        return costs.sum() + jnp.where(actions[0] == END, jnp.inf, 0.0)

    energy = leap.from_total(lambda params, context: (), total, NUM_ACTIONS)
    return compiled(energy, temperature=1.0)


def start(seed: int) -> int:
    return max(seed % 7 - 1, 0)


@pytest.mark.parametrize("length", [0, 1, 3])
def test_history_against_everything_that_happened(length):
    rng = np.random.default_rng(0)
    states = [
        {"grid": rng.integers(1, 9, (2, 2)).astype(np.uint8), "x": np.float32(rng.normal())}
        for _ in range(8)
    ]
    actions = rng.integers(0, 3, 7).tolist()
    rewards = (rng.integers(-9, 10, 7) / 4).tolist()
    history = History(states[0], length, NUM_ACTIONS)
    contexts = [history.context()]
    for action, state, reward in zip(actions, states[1:], rewards, strict=True):
        history.advance(action, state, reward)
        contexts.append(history.context())
    # Compared at the end, so that a later step that changes an earlier context shows.
    for now, context in enumerate(contexts):
        assert context.step == now == int(context.step)
        assert context.return_so_far == sum(rewards[:now])
        assert context.return_so_far.dtype == context.rewards.dtype == np.float32
        jax.tree.map(np.testing.assert_array_equal, context.observation, states[now])
        assert context.past["grid"].shape == (length, 2, 2)
        for values in (context.past["x"], context.actions, context.rewards):
            assert values.shape == (length,)
        assert context.past["grid"].dtype == np.uint8 and context.actions.dtype == np.int32
        for slot in range(length):
            step = now - length + slot
            if step < 0:
                assert context.actions[slot] == PAD and context.rewards[slot] == 0
                assert not context.past["grid"][slot].any() and context.past["x"][slot] == 0
            else:
                assert context.actions[slot] == actions[step]
                assert context.rewards[slot] == rewards[step]
                np.testing.assert_array_equal(context.past["grid"][slot], states[step]["grid"])
                assert context.past["x"][slot] == states[step]["x"]


@pytest.mark.parametrize("length", [0, 2])
def test_stacked_contexts_are_the_contexts_one_after_the_other(length):
    histories = []
    for episode in range(4):
        history = History({"x": np.array([10 * episode])}, length, NUM_ACTIONS)
        for step in range(episode):
            history.advance(step, {"x": np.array([10 * episode + step + 1])}, float(step - 5))
        histories.append(history)
    stacked = stack_contexts(histories)
    assert stacked.actions.shape == stacked.rewards.shape == (4, length)
    np.testing.assert_array_equal(stacked.return_so_far, [0, -5, -9, -12])
    np.testing.assert_array_equal(stacked.step, [0, 1, 2, 3])
    for row, history in enumerate(histories):
        jax.tree.map(
            lambda whole, one, r=row: np.testing.assert_array_equal(whole[r], one),
            stacked,
            history.context(),
        )


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_the_end_action_stops_a_plan_and_makes_the_next(steps):
    seeds = [0, 3, 6, 4]
    episodes = leap.evaluate(Corridor, seeds, walker(), jnp.int32(steps), context=0)
    distances = np.array([GOAL - start(seed) for seed in seeds])
    np.testing.assert_array_equal(episodes.seeds, seeds)
    assert episodes.successes.all()
    np.testing.assert_array_equal(episodes.lengths, distances)
    np.testing.assert_array_equal(episodes.returns, [sum(c.rewards) for c in Corridor.made])
    # Every plan is good for so many steps, and an episode that is over asks for none.
    assert episodes.plans == np.ceil(distances / steps).sum()
    assert 0 < episodes.planning_seconds <= episodes.seconds


@pytest.mark.parametrize("executed", [1, 2, 3, 4, None])
def test_only_so_many_actions_are_executed(executed):
    seeds = [0, 5]
    episodes = leap.evaluate(
        Corridor, seeds, walker(), jnp.int32(HORIZON), context=0, executed=executed
    )
    distances = np.array([GOAL - start(seed) for seed in seeds])
    assert episodes.plans == np.ceil(distances / (executed or HORIZON)).sum()
    np.testing.assert_array_equal(episodes.lengths, distances)


@pytest.mark.parametrize("iteration", [1, 2, ITERATIONS, None])
def test_the_plan_is_executed_as_it_stood_after_an_iteration(iteration):
    differ = 0
    for seed in (1, 2, 8):
        recorder = Recorder(stroller())
        leap.evaluate(
            Corridor,
            [seed],
            recorder,
            None,
            context=0,
            iteration=iteration,
            executed=3,
            progress=give_up_after(200),
        )
        planned = []
        for plans in recorder.plans:
            [trace], [final] = plans.trace, plans.actions
            chosen = trace[-1 if iteration is None else iteration - 1, :3].tolist()
            planned += chosen[: chosen.index(END)] if END in chosen else chosen
            differ += chosen != final[:3].tolist()
        taken = Corridor.made[-1].taken
        assert taken == planned[: len(taken)]
        assert len(planned) - len(taken) < 3  # the episode may be over before its last plan is
    assert (differ > 0) == (iteration in (1, 2))


def test_a_plan_that_is_begun_is_executed_as_far_as_it_goes():
    """Every iteration of beam search chooses one action more; what is not chosen is not done."""
    weight = jnp.array([1.0, 0.0, jnp.inf])  # of LEFT, RIGHT and END: always to the right

    def logits(params, memory, tokens, positions):
        return jnp.tile(-weight, (positions.shape[0], 1))

    energy = leap.autoregressive(lambda params, context: (), logits, NUM_ACTIONS)
    plan = leap.compile_planner(energy, leap.BeamConfig(HORIZON, beams=2))
    for iteration in range(1, HORIZON + 1):
        Corridor.made = []
        episodes = leap.evaluate(Corridor, [1], plan, None, context=0, iteration=iteration)
        assert episodes.successes.all() and Corridor.made[0].taken == [RIGHT] * GOAL
        assert episodes.plans == -(-GOAL // iteration)


def test_finished_episodes_leave_the_batch():
    seeds = [0, 6, 3, 4]
    distances = [GOAL - start(seed) for seed in seeds]
    recorder = Recorder(walker())
    reported = []
    leap.evaluate(
        Corridor,
        seeds,
        recorder,
        jnp.int32(1),
        context=2,
        progress=lambda *numbers: reported.append(numbers),
    )
    assert len(recorder.contexts) == max(distances)
    for call, contexts in enumerate(recorder.contexts):
        left = [seed for seed, distance in zip(seeds, distances, strict=True) if distance > call]
        positions = np.array([start(seed) + call for seed in left])
        np.testing.assert_array_equal(contexts.observation["position"], positions)
        np.testing.assert_array_equal(contexts.step, np.full(len(left), call))
        gained = sum((positions - back) / 4 for back in range(call))
        np.testing.assert_array_equal(contexts.return_so_far, gained + 0 * positions)
        for back in (1, 2):
            known = call >= back
            past = contexts.past["position"][:, -back]
            np.testing.assert_array_equal(past, positions - back if known else 0 * positions)
            assert (contexts.actions[:, -back] == (RIGHT if known else PAD)).all()
            reward = (positions - back + 1) / 4 if known else 0 * positions
            np.testing.assert_array_equal(contexts.rewards[:, -back], reward)
    over = [sum(distance <= call + 1 for distance in distances) for call in range(max(distances))]
    assert reported == [(number, number) for number in over]


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
    eager = leap.evaluate(EagerCorridor, [4, 5, 6], walker(), jnp.int32(2), context=0)
    plain = leap.evaluate(Corridor, [4, 5, 6], walker(), jnp.int32(2), context=0)
    for field in ("successes", "lengths", "returns", "plans"):
        np.testing.assert_array_equal(getattr(eager, field), getattr(plain, field), field)
    calls = EagerCorridor.calls
    assert calls[:3] == [("begin", RIGHT)] * 3 and calls[3][0] == "step"
    # The first action of each plan begins; the second is taken as ever.
    assert [kind for kind, _ in calls].count("begin") == eager.plans
    assert [kind for kind, _ in calls].count("step") == eager.lengths.sum() > eager.plans


def test_an_episode_is_a_success_only_where_the_environment_says_so():
    def always_left(params, context):
        return jnp.full(HORIZON, LEFT)

    def there_and_back(params, context):
        return jnp.where((context.step + jnp.arange(HORIZON)) % 2 == 0, RIGHT, LEFT)

    fallen = leap.evaluate(
        Corridor, [2, 5], compiled(scripted_energy(always_left)), None, context=0
    )
    assert not fallen.successes.any()
    np.testing.assert_array_equal(fallen.lengths, [2, 5])
    np.testing.assert_array_equal(fallen.returns, [-0.25, 1.25])  # (0 - 1) / 4, (3+2+1+0-1) / 4
    late = leap.evaluate(Corridor, [2], compiled(scripted_energy(there_and_back)), None, context=0)
    assert not late.successes.any()
    assert late.lengths == [LIMIT]
    assert late.plans == np.ceil(LIMIT / HORIZON)


class Slippery(Corridor):
    """Goes left, whatever it is asked for, and says so."""

    def step(self, action: int) -> Transition:
        return super().step(LEFT)._replace(taken=LEFT)


def test_a_context_remembers_what_was_executed():
    """As demonstrations do, not what was asked for."""

    def right_until_it_went_left(params, context):
        return jnp.full(HORIZON, jnp.where(context.actions[-1] == LEFT, END, RIGHT))

    plan = compiled(scripted_energy(right_until_it_went_left))
    played = leap.evaluate(Slippery, [5], plan, None, context=1, executed=1)
    assert played.lengths.tolist() == [1]


class Scored(Corridor):
    """Counts ten for each step; what a planner sees stays the reward."""

    def step(self, action: int) -> Transition:
        return super().step(action)._replace(score=10.0)


def test_scores_are_reported_and_rewards_are_seen():
    def left_until_a_reward(params, context):  # the first step to the right gives 3 / 4
        seen = (context.return_so_far == 0.75) & (context.rewards[-1] == 0.75)
        return jnp.where(seen, jnp.full(HORIZON, LEFT), jnp.full(HORIZON, RIGHT))

    plan = compiled(scripted_energy(left_until_a_reward))
    episodes = leap.evaluate(Scored, [3], plan, None, context=1, executed=1, max_steps=2)
    assert Scored.made[-1].taken == [RIGHT, LEFT]
    np.testing.assert_array_equal(episodes.returns, [20.0])


def play(seeds, **options):
    episodes = leap.evaluate(
        Corridor, seeds, stroller(), None, context=1, progress=give_up_after(200), **options
    )
    made = Corridor.made[-len(seeds) :]
    return {
        seed: (bool(success), int(length), adapter.taken)
        for seed, success, length, adapter in zip(
            seeds, episodes.successes, episodes.lengths, made, strict=True
        )
    }


def test_an_episode_plays_the_same_way_alone_or_in_any_batch():
    seeds = list(range(20, 29))
    together = play(seeds)
    assert len({str(result) for result in together.values()}) > 4
    for subset in ([20], seeds[::-1], seeds[3:6]):
        assert play(subset) == {seed: together[seed] for seed in subset}
    for result, length, taken in together.values():
        assert length == len(taken) and (not result or length >= 1)


def test_the_seed_of_the_planner_matters_and_suffices():
    seeds = list(range(20, 29))
    assert play(seeds, seed=1) == play(seeds, seed=1)
    assert play(seeds, seed=1) != play(seeds, seed=2)


def ends_at_once(params, context):
    return jnp.full(HORIZON, END)


class StuckError(Exception):
    pass


def give_up_after(rounds: int):
    calls = []

    def progress(over: int, succeeded: int) -> None:
        calls.append(over)
        if len(calls) > rounds:
            raise StuckError

    return progress


def test_episodes_that_were_played_side_by_side():
    first, second, whole = (
        leap.evaluate(Corridor, seeds, walker(), jnp.int32(2), context=0)
        for seeds in ([0, 3], [6], [0, 3, 6])
    )
    joined = join([first, second])
    for field in ("seeds", "successes", "lengths", "returns", "plans"):
        np.testing.assert_array_equal(getattr(joined, field), getattr(whole, field), field)
    assert joined.seconds == max(first.seconds, second.seconds)


def test_plans_that_end_at_once_do_not_go_on_for_ever():
    plan = compiled(scripted_energy(ends_at_once))
    leap.evaluate(Corridor, [0], plan, None, context=0, progress=give_up_after(50))


@pytest.mark.parametrize("max_steps", [1, 3, 6, 9])
def test_an_episode_may_be_cut_off(max_steps):
    seeds = [0, 3, 6]
    episodes = leap.evaluate(
        Corridor, seeds, walker(), jnp.int32(2), context=0, max_steps=max_steps
    )
    distances = np.array([GOAL - start(seed) for seed in seeds])
    np.testing.assert_array_equal(episodes.lengths, np.minimum(distances, max_steps))
    np.testing.assert_array_equal(episodes.successes, distances <= max_steps)
    assert episodes.plans == np.ceil(episodes.lengths / 2).sum()


@pytest.mark.parametrize("option", ["executed", "max_steps"])
def test_to_execute_nothing_is_refused(option):
    with pytest.raises(ValueError, match=f"{option} must be at least 1, got 0"):
        leap.evaluate(Corridor, [0], walker(), jnp.int32(1), context=0, **{option: 0})


class WiderCorridor(Corridor):
    num_actions = NUM_ACTIONS + 1


class GrowingCorridor(Corridor):
    def observe(self):
        return {"position": np.zeros(self.steps, np.int32), "goal": np.array([GOAL], np.int32)}


@pytest.mark.parametrize(
    ("make", "seeds", "says"),
    [
        (Corridor, [], "no seeds"),
        (functools.cache(Corridor), [0, 1], "same environment twice"),
        (WiderCorridor, [0], "planner has 3 actions and the environment 4"),
        (GrowingCorridor, [0], "observation of other shapes"),
    ],
)
def test_environments_that_would_give_wrong_episodes_are_refused(make, seeds, says):
    with pytest.raises(ValueError, match=says):
        leap.evaluate(make, seeds, walker(), jnp.int32(1), context=0)


@pytest.mark.parametrize("iteration", [0, ITERATIONS + 1])
def test_an_iteration_that_there_is_not_is_refused(iteration):
    with pytest.raises(ValueError, match="iteration"):
        leap.evaluate(Corridor, [0], walker(), jnp.int32(1), context=0, iteration=iteration)


def test_an_environment_may_reuse_its_buffers():
    buffer = {"x": np.zeros(2)}
    history = History(buffer, 2, NUM_ACTIONS)
    for step in (1.0, 2.0):
        buffer["x"][:] = step
        history.advance(0, buffer, 0.0)
    np.testing.assert_array_equal(history.context().past["x"], [[0, 0], [1, 1]])
    np.testing.assert_array_equal(history.context().observation["x"], [2, 2])


class Line(gym.Env):
    """Gymnasium's view of a corridor: action 0 stays, 1 goes on, 2 gives up."""

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
    first = adapter.reset(3)
    np.testing.assert_array_equal(adapter.reset(3), first)
    assert {float(adapter.reset(seed)[0]) for seed in range(20)} == {0.0, 1.0, 2.0}
    adapter.env.position = 3
    stay = adapter.step(0)
    assert (stay.reward, stay.terminated, stay.truncated, stay.success) == (-1, False, False, False)
    arrive = adapter.step(1)
    assert (arrive.reward, arrive.terminated, arrive.success) == (2.0, True, True)
    np.testing.assert_array_equal(arrive.observation, [4.0])
    adapter.reset(0)
    given_up = adapter.step(2)
    assert given_up.terminated and not given_up.success
    adapter.reset(0)
    late = [adapter.step(0) for _ in range(9)][-1]
    assert late.truncated and not late.terminated and not late.success


def test_success_is_a_return_where_one_is_asked_for():
    """In CartPole every step is rewarded, the one with which the pole falls too."""
    for asked, succeeds in ((None, False), (8.0, True), (100.0, False)):
        adapter = GymnasiumAdapter(gym.make("CartPole-v1"), asked)
        adapter.reset(0)
        steps = [adapter.step(0)]
        while not steps[-1].terminated:
            steps.append(adapter.step(0))
        assert 8 <= len(steps) < 100 and steps[-1].reward > 0
        assert steps[-1].success == succeeds
        so_far = [asked is not None and count >= asked for count in range(1, len(steps) + 1)]
        assert [step.success for step in steps] == so_far


def test_evaluation_in_a_gymnasium_environment():
    made = []

    def make() -> GymnasiumAdapter:
        made.append(GymnasiumAdapter(Line()))
        return made[-1]

    def on_or_up(params, context):
        return jnp.where(context.observation[0] < params, 1, 2) * jnp.ones(HORIZON, jnp.int32)

    def total(params, wanted, actions):
        return jnp.sum(actions != wanted).astype(jnp.float32)

    plan = compiled(leap.from_total(on_or_up, total, 4))
    seeds = [0, 1, 2, 3, 4]
    starts = np.array([int(GymnasiumAdapter(Line()).reset(seed)[0]) for seed in seeds])
    assert len(set(starts.tolist())) > 1
    episodes = leap.evaluate(make, seeds, plan, jnp.float32(1.5), context=0)
    np.testing.assert_array_equal(episodes.successes, starts < 1.5)
    np.testing.assert_array_equal(episodes.lengths, np.where(starts < 1.5, 4 - starts, 1))
    # All steps cost one but the last, which gives two where it arrives.
    np.testing.assert_array_equal(episodes.returns, np.where(starts < 1.5, starts - 1, -1))
    assert len(made) == len(seeds)


@pytest.mark.parametrize(
    "space",
    [gym.spaces.Box(-1, 1, (2,)), gym.spaces.MultiDiscrete([2, 3]), gym.spaces.MultiBinary(2)],
)
def test_other_action_spaces_are_refused(space):
    with pytest.raises(ValueError, match="Discrete action space"):
        GymnasiumAdapter(Line(space))


class OldLine(Line):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed, options=options)[0]


def test_an_environment_of_the_old_interface_is_refused():
    with pytest.raises(TypeError, match=r"not \(observation, info\): .*old interface"):
        GymnasiumAdapter(OldLine()).reset(0)


def test_actions_that_do_not_start_at_zero():
    adapter = GymnasiumAdapter(Line(gym.spaces.Discrete(2, start=1)))
    adapter.reset(0)
    for action in range(adapter.num_actions - 1):
        adapter.step(action)
    assert adapter.env.taken == [1, 2]


# What enters.


@pytest.mark.parametrize("wrong", [2**32, -1, 5.9, True, "5", math.nan])
@pytest.mark.parametrize("edge", ["level seed", "seed"])
def test_seeds_that_jax_does_not_tell_apart_are_refused(edge, wrong):
    seeds, seed = ([1, wrong], 0) if edge == "level seed" else ([1], wrong)
    with pytest.raises(UserError, match=f"{edge} must be"):
        leap.evaluate(Corridor, seeds, walker(), jnp.int32(1), context=0, seed=seed)
    assert not Corridor.made  # it is said before anything is made


@pytest.mark.parametrize("wrong", [-1, 1.5, 2.0, True, math.nan, math.inf, "2"])
@pytest.mark.parametrize("count", ["context", "executed", "iteration", "max_steps"])
def test_counts_are_integers(count, wrong):
    with pytest.raises(UserError, match=f"{count} must be"):
        leap.evaluate(Corridor, [0], walker(), jnp.int32(1), **{"context": 0, count: wrong})
    assert not Corridor.made


def test_integers_of_numpy_are_counts_and_seeds():
    few = {"context": np.int8(0), "executed": np.int64(1), "max_steps": np.uint8(3)}
    played = leap.evaluate(Corridor, np.array([0, 3]), walker(), jnp.int32(4), **few)
    assert played.lengths.tolist() == [3, 3] and played.plans == 6


# What an environment gives.


class Strange(Corridor):
    """A corridor whose second step gives something else."""

    given: ClassVar[dict] = {}

    def step(self, action: int) -> Transition:
        found = super().step(action)
        return found._replace(**self.given) if self.steps == 2 else found


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"reward": math.nan}, "reward of nan"),
        ({"reward": -math.inf}, "reward of -inf"),
        ({"reward": 1e39}, "reward of 1e[+]39"),  # not in the numbers that planners see
        ({"score": math.nan}, "score of nan"),
        (
            {"observation": {"position": np.float32(np.nan), "goal": np.zeros(1)}},
            "observation.*pos",
        ),
        (
            {"observation": {"position": np.zeros(()), "goal": np.array([np.inf])}},
            "observation.*go",
        ),
        ({"observation": {"position": np.zeros(())}}, "other shapes"),
        ({"taken": NUM_ACTIONS}, "action taken"),
        ({"taken": 0.5}, "action taken"),
    ],
)
def test_values_that_no_data_may_have_are_refused(monkeypatch, given, says):
    monkeypatch.setattr(Strange, "given", given)
    with pytest.raises(UserError, match=f"{says}.* step 2 of level seed 7"):
        leap.evaluate(Strange, [7], walker(), jnp.int32(4), context=1)


def test_a_first_observation_that_is_not_finite_is_refused():
    with pytest.raises(UserError, match="not finite at step 0 of level seed 3"):
        History((np.zeros(2), np.array([1, np.nan], np.float16)), 0, NUM_ACTIONS, 3)
    with pytest.raises(UserError, match="length must be at least 0"):
        History(np.zeros(2), -1, NUM_ACTIONS)


def test_rewards_may_not_add_up_to_more_than_a_planner_can_see():
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
    reported = []
    few, all_at_once = (
        leap.evaluate(
            make, seeds, stroller(), None, context=1, max_steps=9,
            progress=lambda *numbers: reported.append(numbers),
        )
        for make in (held, Corridor)
    )  # fmt: skip
    first = next(i for i, each in enumerate(reported) if each[0] == len(seeds))
    assert held.most == 3 and not held.open
    assert reported[: first + 1] == sorted(reported[: first + 1])
    for field in ("seeds", "successes", "lengths", "returns", "plans"):
        np.testing.assert_array_equal(getattr(few, field), getattr(all_at_once, field), field)
    assert len(set(few.lengths.tolist())) > 2


@pytest.mark.parametrize("error", [StuckError, KeyboardInterrupt])
def test_all_is_closed_where_playing_ends_early(held, error):
    def progress(over, succeeded):
        raise error

    with pytest.raises(error):
        leap.evaluate(held, range(9), walker(), jnp.int32(1), context=0, progress=progress)
    assert held.most == 3 and not held.open


def test_an_error_of_a_step_or_of_what_is_made_closes_the_rest(held, monkeypatch):
    monkeypatch.setattr(held, "fails_at", 4)
    with pytest.raises(StuckError):
        leap.evaluate(held, range(9), walker(), jnp.int32(1), context=0)
    assert held.most == 3 and not held.open
    with pytest.raises(UserError, match="same environment twice"):
        leap.evaluate(functools.cache(held), [0, 1], walker(), jnp.int32(1), context=0)
    assert not held.open


class Unclosable(Corridor):
    def close(self) -> None:
        raise OSError("the port is gone")


def test_what_goes_wrong_first_is_what_is_told():
    with pytest.raises(StuckError), closing(Unclosable()):
        raise StuckError
    with pytest.raises(OSError, match="port is gone"), closing(Unclosable()):
        pass
    with pytest.raises(StuckError):
        leap.evaluate(Unclosable, [0], walker(), jnp.int32(1), context=0, progress=give_up_after(0))
    with closing(Corridor()) as corridor:  # has nothing to close
        corridor.reset(0)


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
    np.testing.assert_array_equal(episodes.lengths, [GOAL - start(seed) for seed in seeds])
    for contexts, cache in zip(recorder.contexts, recorder.caches, strict=True):
        if executed == 2:
            assert cache is None
        elif cache is None:
            np.testing.assert_array_equal(contexts.step, 0)
        else:
            np.testing.assert_array_equal(contexts.step, cache["plans"])
            position = cache["observation"]["position"]
            np.testing.assert_array_equal(contexts.observation["position"], position + 1)


# What episodes share.

ONE = Line()


class Wrapped:
    """An adapter inside another."""

    num_actions = 4

    def __init__(self, inner: GymnasiumAdapter) -> None:
        self.inner = inner
        self.reset, self.step = inner.reset, inner.step


class Common(GymnasiumAdapter):
    """The environment is the class's."""

    env = ONE

    def __init__(self) -> None:
        super().__init__(ONE)
        del self.env


class Late(GymnasiumAdapter):
    """Takes its environment when it is reset."""

    def __init__(self) -> None:
        super().__init__(Line())

    def reset(self, seed: int):
        self.env = ONE
        return super().reset(seed)


@pytest.mark.parametrize(
    "make",
    [
        lambda: GymnasiumAdapter(ONE),
        lambda: GymnasiumAdapter(gym.wrappers.TimeLimit(ONE, 5)),
        lambda: GymnasiumAdapter(gym.wrappers.OrderEnforcing(gym.wrappers.TimeLimit(ONE, 5))),
        lambda: Wrapped(GymnasiumAdapter(ONE)),
        Common,
        Late,
    ],
)
def test_one_environment_in_two_adapters_is_found(make):
    with pytest.raises(UserError, match="same environment twice"):
        leap.evaluate(make, [0, 1], stayer(), None, context=0)
    assert leap.evaluate(make, [0], stayer(), None, context=0, max_steps=4).lengths == [4]


@functools.cache
def stayer() -> leap.CompiledPlanner:
    """Stays where it is, in a `Line`."""
    energy = leap.from_total(
        lambda params, context: (), lambda p, m, actions: actions.sum().astype(jnp.float32), 4
    )
    return compiled(energy)


class Odd(Corridor):
    """A corridor whose steps return something else."""

    def __init__(self, **changed) -> None:
        super().__init__()
        self.changed = changed

    def step(self, action: int):
        found = super().step(action)
        return self.changed["step"] if "step" in self.changed else found._replace(**self.changed)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: gym.make("CartPole-v1"), "returned TimeLimit, expected an Adapter.*Gymnasium"),
        (lambda: None, "returned NoneType, expected an Adapter"),
        (lambda: Corridor, "returned the class Corridor"),
        (Corridor(), "make_adapter is Corridor: expected a function"),
        (lambda: Odd(step=(0, 1.0, True, False, {})), "step of Odd returned tuple"),
        (lambda: Odd(reward="1"), "reward of 1 at step 1 of level seed 3: expected a number"),
        (lambda: Odd(reward=None), "reward of None"),
        (lambda: Odd(reward=np.ones(1)), r"reward of \[1\.\]"),
        (lambda: Odd(score=np.zeros(2)), "score of "),
        (lambda: Odd(success="no"), "success at step 1 of level seed 3 must be true or false"),
        (lambda: Odd(terminated=None), "terminated at step 1"),
        (lambda: Odd(truncated=math.nan), "truncated at step 1"),
    ],
)
def test_an_environment_of_another_kind_is_named(make, says):
    with pytest.raises(UserError, match=says):
        rollouts.evaluate(make, [3], walker(), np.int32(4), context=0)


def test_numbers_and_marks_of_any_type_are_taken():
    plain = rollouts.evaluate(Corridor, [3], walker(), np.int32(4), context=0)
    for one in (np.float16, np.array, jnp.float32, np.uint8):
        found = rollouts.evaluate(
            lambda one=one: Odd(reward=one(1), score=one(1), truncated=one(0)),
            [3], walker(), np.int32(4), context=0,
        )  # fmt: skip
        assert found.successes == plain.successes and found.returns == found.lengths


def test_an_environment_in_slots_is_found_and_a_list_of_them_is_not_searched():
    shared = gym.make("CartPole-v1")

    class Slotted:
        __slots__ = ("empty", "inner")

    slotted = Slotted()
    slotted.inner = GymnasiumAdapter(shared)
    assert environments_of(slotted) == [shared.unwrapped]
    listed = Corridor()
    listed.pool = [slotted.inner]
    assert environments_of(listed) == []


def test_gymnasium_adapters_name_what_is_no_environment():
    with pytest.raises(UserError, match="expected a Gymnasium environment"):
        GymnasiumAdapter("CartPole-v1")
    env = gym.make("CartPole-v1")
    for found, says in [((0, 1.0, True, {}), "4 values"), ((0, None, 1, 0, {}), "of None")]:
        adapter = GymnasiumAdapter(env)
        adapter.env = types.SimpleNamespace(step=lambda action, found=found: found)
        with pytest.raises(UserError, match=says):
            adapter.step(0)
