"""Plays many episodes in lockstep: plans for many in one call, acts, and replans."""

import contextlib
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from leapjax.batching import CompiledPlanner, plan_keys
from leapjax.checks import check_flag, check_integer, check_seed, check_seeds
from leapjax.environments import Adapter, Eager, Transition, close, list_environments
from leapjax.errors import UserError
from leapjax.types import Array, Context, Params, Plan, PyTree, pad_token, to_plain_dicts

MOST_OPEN = 128  # environments at once: plans in a chunk. Each may hold files or a port.
LARGEST = float(np.finfo(np.float32).max)


class Episodes(NamedTuple):
    """The results of E episodes.

    Attributes:
        seeds: `[E]` level seeds.
        successes: `[E]` bool.
        lengths: `[E]` int, environment steps.
        returns: `[E]` float, sums of rewards, or of scores if the environment reports scores.
        plans: number of plans in all episodes.
        passes: passes of the model in all plans (see `Plan.passes`).
        planning_seconds: seconds of the planner alone, compilation included.
        seconds: seconds in all.
    """

    seeds: np.ndarray
    successes: np.ndarray
    lengths: np.ndarray
    returns: np.ndarray
    plans: int
    passes: int
    planning_seconds: float
    seconds: float


def join(parts: Sequence[Episodes]) -> Episodes:
    """Joins results of parallel episodes: adds their plans, and takes the longest times."""
    return Episodes(
        np.concatenate([part.seeds for part in parts]),
        np.concatenate([part.successes for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        np.concatenate([part.returns for part in parts]),
        sum(part.plans for part in parts),
        sum(part.passes for part in parts),
        max(part.planning_seconds for part in parts),
        max(part.seconds for part in parts),
    )


class History:
    """The last K states, actions and rewards of one episode, as a planner's context.

    Args:
        observation: observation of the first state.
        length: K.
        num_actions: A, the end action included.
        seed: level seed, for messages.

    Raises:
        UserError: see `advance`.
    """

    def __init__(
        self, observation: PyTree, length: int, num_actions: int, seed: int | None = None
    ) -> None:
        self.step = 0
        self.return_so_far = 0.0
        self._seed = seed
        self._length = check_integer("length", length)
        self._num_actions = num_actions
        self._past: list[PyTree] = []
        self._actions: list[int] = []
        self._rewards: list[float] = []
        self._structure: Any
        leaves, self._structure = jax.tree.flatten(to_plain_dicts(observation))
        self._shapes = list(map(np.shape, leaves))
        self.current = self._checked(observation)
        self._blank = jax.tree.map(np.zeros_like, self.current)

    @property
    def where(self) -> str:
        """The step and the level seed, for messages."""
        return f"step {self.step}" + ("" if self._seed is None else f" of level seed {self._seed}")

    def advance(self, action: int, observation: PyTree, reward: float) -> None:
        """Records one step.

        Args:
            action: the action taken.
            observation: the observation after it.
            reward: the reward of the step.

        Raises:
            UserError: The observation has other parts or shapes than the first, or numbers that are
                not finite. The reward or the return is not finite or does not fit float32. The
                action is not an integer in 0 .. A - 1.
        """
        self.step += 1
        action = check_integer(
            f"the action taken at {self.where}", action, 0, self._num_actions - 1
        )
        number = _read_number("reward", reward, self.where)
        if self._length:
            self._past = [*self._past, self.current][-self._length :]
            self._actions = [*self._actions, action][-self._length :]
            self._rewards = [*self._rewards, number][-self._length :]
        self.current = self._checked(observation)
        self.return_so_far += number
        for name, value in (("reward", number), ("return", self.return_so_far)):
            if not -LARGEST <= value <= LARGEST:
                raise UserError(
                    f"the environment gave a {name} of {value} at {self.where}: expected a finite "
                    "number that fits float32"
                )

    def _checked(self, observation: PyTree) -> PyTree:
        """Checks and copies an observation: the next step may write into the same arrays."""
        structure: Any
        observation = to_plain_dicts(observation)
        leaves, structure = jax.tree.flatten(observation)
        copies = list(map(np.array, leaves))
        shapes = [copy.shape for copy in copies]
        if structure != self._structure or shapes != self._shapes:
            raise UserError(
                f"an observation of other shapes than the first at {self.where}: "
                f"{structure.unflatten(shapes)}, not {self._structure.unflatten(self._shapes)}"
            )
        for place, copy in enumerate(copies):
            if copy.dtype.kind == "f" and not np.isfinite(copy).all():
                path, _ = jax.tree.leaves_with_path(observation)[place]
                raise UserError(
                    f"the environment gave an observation{jax.tree_util.keystr(path)} with numbers "
                    f"that are not finite at {self.where}"
                )
        return structure.unflatten(copies)

    def context(self) -> Context:
        """Returns the context as NumPy arrays, padded at the front in the first K steps."""
        missing, pad = self._length - len(self._past), pad_token(self._num_actions)
        past = [self._blank] * missing + self._past
        if past:
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *past)
        else:
            stacked = jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), self._blank)
        return Context(
            observation=self.current,
            past=stacked,
            actions=np.array([pad] * missing + self._actions, np.int32),
            rewards=np.array([0.0] * missing + self._rewards, np.float32),
            step=np.array(self.step, np.int32),
            return_so_far=np.array(self.return_so_far, np.float32),
        )


def check_limits(executed: int | None, max_steps: int | None) -> tuple[int | None, int | None]:
    """Checks two limits, and returns each as an `int`, or `None` if it is not set.

    Args:
        executed: number of actions to execute of a plan.
        max_steps: number of steps of an episode.

    Raises:
        UserError: a limit is not an integer, or less than 1.
    """
    limits = {"executed": executed, "max_steps": max_steps}
    checked = [
        None if value is None else check_integer(name, value, 1, sys.maxsize)
        for name, value in limits.items()
    ]
    return checked[0], checked[1]


def check_adapter(adapter: Adapter) -> None:
    """Checks that a value is an `Adapter`.

    Raises:
        UserError: it is not. The message names its type, and says how to wrap a Gymnasium
            environment.
    """
    # `isinstance` would miss attributes that a wrapper finds in its `__getattr__`.
    parts = ("num_actions", "reset", "step")
    if isinstance(adapter, type) or not all(hasattr(adapter, part) for part in parts):
        raise UserError(
            f"make_adapter returned {_name_kind(adapter)}, expected an Adapter, which has "
            "num_actions, reset(seed) and step(action): "
            "leapjax.environments.GymnasiumAdapter(env) makes one of a Gymnasium environment"
        )


def _name_kind(value: Any) -> str:
    """Names the type of a value, for a message."""
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def _read_number(name: str, value: Any, where: str) -> float:
    """Returns a reward or a score as a `float`, which may be NaN or infinite.

    Args:
        name: name of the number, for the message.
        value: one real number of any type.
        where: episode and step, for the message.

    Raises:
        UserError: the value is not a single real number.
    """
    try:
        if isinstance(value, str | bytes) or np.ndim(value):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise UserError(
            f"the environment gave a {name} of {str(value)[:60]} at {where}: expected a number"
        ) from None


def check_actions(of: str, planned: int, possible: int) -> None:
    """Checks that a planner or an energy has as many actions as its environment.

    Args:
        of: "planner" or "energy", for the message.
        planned: A of the plans.
        possible: A of the environment.

    Raises:
        ValueError: the numbers differ; the message gives both.
    """
    possible = check_integer("num_actions of the environment", possible, 1)
    if possible != planned:
        raise ValueError(
            f"the {of} has {planned} actions and the environment {possible}, the end action "
            "included in both"
        )


def stack_contexts(histories: Sequence[History]) -> Context:
    """Stacks the contexts of B episodes: each leaf gets a leading `[B]`."""
    contexts = [history.context() for history in histories]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *contexts)


class _Episode:
    """An episode in progress: its index, its environment, and its history for the planner."""

    def __init__(self, place: int, seed: int, adapter: Adapter, history: History) -> None:
        self.place, self.seed = place, seed
        self.adapter, self.history = adapter, history
        self.eager = adapter if isinstance(adapter, Eager) else None
        # Objects that only this episode may step, by identity.
        self.owned = {id(part): part for part in (adapter, *list_environments(adapter))}
        self.replans = 0
        self.cache: PyTree = None  # its row of the cache of the last plans


def plan_episodes(
    plan: CompiledPlanner,
    params: Params,
    keys: Array,
    histories: Sequence[History],
    caches: Sequence[PyTree],
    executed: int | None,
) -> tuple[Plan, list[PyTree]]:
    """Plans for B episodes; returns the plans, and each episode's cache for its next plan.

    Args:
        plan: from `compile_planner`.
        params: parameters of the energy.
        keys: `[B]`, see `CompiledPlanner`.
        histories: of the episodes.
        caches: of the episodes, all from their last plan, or all `None`.
        executed: number of actions that will be executed of each plan; `None` for all. If it is
            more than 1, the returned caches are `None`: the states in between are not encoded.
    """
    stacked = jax.tree.map(lambda *rows: np.stack(rows), *caches)
    plans, cache = plan.plan_next(params, keys, stack_contexts(histories), stacked)
    if cache is None or (executed != 1 and plans.actions.shape[1] != 1):
        return plans, [None] * len(histories)
    return plans, [jax.tree.map(lambda x, n=n: x[n], cache) for n in range(len(histories))]


def _group_alike(episodes: Sequence[_Episode]) -> Iterator[list[_Episode]]:
    """Groups episodes that can share a call of the planner: with a cache, and without."""
    for begun in (True, False):
        group = [each for each in episodes if (each.cache is not None) == begun]
        if group:
            yield group


def evaluate(
    make_adapter: Callable[[], Adapter],
    seeds: Sequence[int],
    plan: CompiledPlanner,
    params: Params,
    *,
    context: int,
    seed: int = 0,
    executed: int | None = None,
    iteration: int | None = None,
    max_steps: int | None = None,
    progress: Callable[[int, int], None] = lambda over, succeeded: None,
) -> Episodes:
    """Plays one episode per level seed, in lockstep, replanning when a plan is used up.

    At most `MOST_OPEN` episodes are in progress at once. When an episode is over, its environment
    is closed (see `leapjax.environments.Closable`) and the next episode begins. A plan that starts
    with the end action gives the episode up. A plan's randomness derives from (seed, level seed,
    replan index), so an episode plays the same way whatever else is in the batch.

    Episodes take turns, so their environments must not share state that a step or a reset changes.
    It is an error to return the same adapter twice, or two adapters of the same Gymnasium
    environment (see `leapjax.environments.list_environments`). Other shared state is not detected.

    Args:
        make_adapter: makes one environment; called once per episode, in the order of the seeds.
        seeds: level seeds, integers in 0 .. 2^32 - 1.
        plan: from `compile_planner`.
        params: parameters of the energy.
        context: K.
        seed: seed of the planner's randomness, in 0 .. 2^32 - 1.
        executed: number of actions to execute before replanning; `None` for all T.
        iteration: executes each plan as it stood after this many iterations; `None` for the last.
        max_steps: number of steps after which an episode is cut off; `None` for no limit but the
            environment's.
        progress: called with (episodes over, successes) after every round.

    Raises:
        UserError: There are no seeds, or a seed or a count is not an integer in its range. An
            environment is not an adapter, or is used twice. It gives values that `History` refuses,
            a score that is not finite, or flags that are not booleans.
        ValueError: an environment has other actions than the planner.
        NotANumber: see `CompiledPlanner`.
    """
    if not callable(make_adapter):
        raise UserError(
            f"make_adapter is {_name_kind(make_adapter)}: expected a function that makes a new "
            "adapter for each episode"
        )
    if not hasattr(plan, "plan_next"):
        raise UserError(
            f"plan is {_name_kind(plan)}: expected a compiled planner, such as planner.plan"
        )
    level_seeds = check_seeds(seeds, "level seed")
    seed, context = check_seed(seed), check_integer("context", context)
    executed, max_steps = check_limits(executed, max_steps)
    if iteration is not None:
        iteration = check_integer("iteration", iteration, 1)
    if not len(level_seeds):
        raise UserError("no seeds: there is no episode to play")
    begun = time.perf_counter()
    end = plan.num_actions - 1
    count = len(level_seeds)
    successes, lengths, scores = np.zeros(count, bool), np.zeros(count, int), np.zeros(count)
    waiting = iter(range(count))
    opened: dict[int, Adapter] = {}  # by index
    active: list[_Episode] = []
    owned: set[int] = set()  # ids of objects that active episodes step
    over, planned, passes, planning_seconds = 0, 0, 0, 0.0

    def begin(place: int) -> _Episode:
        level_seed = int(level_seeds[place])
        adapter = opened[place] = make_adapter()
        check_adapter(adapter)
        check_actions("planner", plan.num_actions, adapter.num_actions)
        history = History(adapter.reset(level_seed), context, end + 1, level_seed)
        episode = _Episode(place, level_seed, adapter, history)
        if not owned.isdisjoint(episode.owned):
            raise UserError(
                "make_adapter returned the same environment twice: make a new one for each "
                "episode, since episodes under way take turns"
            )
        owned.update(episode.owned)
        return episode

    def decide(group: Sequence[_Episode]) -> Iterator[tuple[_Episode, np.ndarray]]:
        """Plans for some episodes; pairs each with its next actions, `[executed]`."""
        nonlocal planned, passes, planning_seconds
        before = time.perf_counter()
        keys = plan_keys(
            seed,
            np.array([episode.seed for episode in group], np.uint32),
            np.array([episode.replans for episode in group], np.uint32),
        )
        histories, known = zip(*((each.history, each.cache) for each in group), strict=True)
        plans, caches = plan_episodes(plan, params, keys, histories, known, executed)
        if iteration is not None and iteration > plans.trace.shape[1]:
            raise UserError(f"iteration {iteration} is not in 1 .. {plans.trace.shape[1]}")
        chosen = plans.actions if iteration is None else plans.trace[:, iteration - 1]
        for episode, cache in zip(group, caches, strict=True):
            episode.cache = cache
        planning_seconds += time.perf_counter() - before
        planned += len(group)
        passes += int(np.sum(plans.passes))
        return zip(group, np.asarray(chosen)[:, :executed], strict=True)

    def act(episode: _Episode, actions: np.ndarray) -> bool:
        """Executes a plan; returns whether the episode is over."""
        place, history = episode.place, episode.history
        episode.replans += 1
        for action in actions:
            if action >= end:  # end; or MASK, in the plan of an early iteration
                return bool(actions[0] >= end)
            found = episode.adapter.step(int(action))
            if not isinstance(found, Transition):
                raise UserError(
                    f"step of {type(episode.adapter).__name__} returned {type(found).__name__}: "
                    "expected a leapjax.environments.Transition"
                )
            history.advance(found.executed(int(action)), found.observation, found.reward)
            score = _read_number("score", found.counted, history.where)
            if not math.isfinite(score):
                raise UserError(f"the environment gave a score of {score} at {history.where}")
            scores[place] += score
            lengths[place] = history.step
            too_long = max_steps is not None and history.step >= max_steps
            terminated, truncated, success = (
                check_flag(f"{name} at {history.where}", getattr(found, name))
                for name in ("terminated", "truncated", "success")
            )
            successes[place] = success  # of the last step, also if the planner gives up after it
            if terminated or truncated or too_long:
                return True
        return False

    try:
        while True:
            for place in itertools.islice(waiting, MOST_OPEN - len(active)):
                active.append(begin(place))
            if not active:
                break
            decided = [each for group in _group_alike(active) for each in decide(group)]
            for episode, actions in decided:
                if episode.eager is not None and actions[0] < end:
                    episode.eager.begin(int(actions[0]))
            active = []
            for episode, actions in decided:
                if act(episode, actions):
                    close(opened.pop(episode.place))
                    owned.difference_update(episode.owned)
                    over += 1
                else:
                    active.append(episode)
            progress(over, int(successes.sum()))
    finally:
        for adapter in opened.values():  # after an error, which `close` must not hide
            with contextlib.suppress(Exception):
                close(adapter)
    return Episodes(
        np.asarray(seeds),
        successes,
        lengths,
        scores,
        planned,
        passes,
        planning_seconds,
        time.perf_counter() - begun,
    )
