"""Plan, act, replan: many episodes in lockstep, so that hundreds are planned per call."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from leapjax.batching import CompiledPlanner, plan_keys
from leapjax.environments import Adapter, Eager
from leapjax.types import Array, Context, Params, Plan, PyTree, pad_token, to_plain_dicts


class Episodes(NamedTuple):
    """What E episodes gave."""

    seeds: np.ndarray  # [E] level seeds
    successes: np.ndarray  # [E] bool
    lengths: np.ndarray  # [E] int: environment steps
    returns: np.ndarray  # [E] float: sums of rewards, or of scores where those are something else
    plans: int  # plans made in all
    planning_seconds: float  # of the planner alone, compilation included
    seconds: float  # in all


def join(parts: Sequence[Episodes]) -> Episodes:
    """Episodes that were played side by side: counts add up, the slowest has the say."""
    return Episodes(
        np.concatenate([part.seeds for part in parts]),
        np.concatenate([part.successes for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        np.concatenate([part.returns for part in parts]),
        sum(part.plans for part in parts),
        max(part.planning_seconds for part in parts),
        max(part.seconds for part in parts),
    )


class History:
    """The last K states, actions and rewards of one episode, as a planner's context.

    Args:
        observation: of the first state.
        length: K.
        num_actions: A.
    """

    def __init__(self, observation: PyTree, length: int, num_actions: int) -> None:
        self.current = _copy(observation)
        self.step = 0
        self.return_so_far = 0.0
        self._length = length
        self._past: list[PyTree] = []
        self._actions: list[int] = []
        self._rewards: list[float] = []
        self._encoded: Array | None = None
        self._blank = jax.tree.map(np.zeros_like, self.current)
        self._pad = pad_token(num_actions)

    def advance(
        self, action: int, observation: PyTree, reward: float, encoded: Array | None = None
    ) -> None:
        """Records one step.

        Args:
            action: that was taken.
            observation: what it led to.
            reward: what it gave.
            encoded: `[K, D]` what is known of the states before it, if they are (see `kept`).
        """
        if self._length:
            self._past = [*self._past, self.current][-self._length :]
            self._actions = [*self._actions, action][-self._length :]
            self._rewards = [*self._rewards, reward][-self._length :]
        self._encoded = encoded
        before, self.current = self.current, _copy(observation)
        if jax.tree.map(np.shape, before) != jax.tree.map(np.shape, self.current):
            raise ValueError(
                f"an observation of other shapes than the one before: "
                f"{jax.tree.map(np.shape, self.current)}, not {jax.tree.map(np.shape, before)}"
            )
        self.step += 1
        self.return_so_far += reward

    def context(self) -> Context:
        """As NumPy arrays, padded at the front where the episode is younger than K."""
        missing = self._length - len(self._past)
        past = [self._blank] * missing + self._past
        if past:
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *past)
        else:
            stacked = jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), self._blank)
        return Context(
            observation=self.current,
            past=stacked,
            actions=np.array([self._pad] * missing + self._actions, np.int32),
            rewards=np.array([0.0] * missing + self._rewards, np.float32),
            step=np.array(self.step, np.int32),
            return_so_far=np.array(self.return_so_far, np.float32),
            encoded=self._encoded,
        )


def _check_adapters(adapters: Sequence[Adapter], plan: CompiledPlanner) -> None:
    """Refuses, once, what would give wrong episodes without a word."""
    if not adapters:
        raise ValueError("no seeds: there is no episode to play")
    if len({id(adapter) for adapter in adapters}) < len(adapters):
        raise ValueError("make_adapter returned the same environment twice: make a new one")
    for adapter in adapters:
        check_actions("planner", plan.num_actions, adapter.num_actions)


def check_limits(executed: int | None, max_steps: int | None) -> None:
    """Refuses to execute nothing of a plan, or of an episode.

    Raises:
        ValueError: says which.
    """
    for name, value in {"executed": executed, "max_steps": max_steps}.items():
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def check_actions(of: str, planned: int, possible: int) -> None:
    """Refuses what plans with other actions than its environment has.

    Raises:
        ValueError: says how many there are.
    """
    if possible != planned:
        raise ValueError(
            f"the {of} has {planned} actions and the environment {possible}, the end action "
            "included in both"
        )


def _copy(observation: PyTree) -> PyTree:
    """Environments may write the next observation into the arrays of the last."""
    return jax.tree.map(np.array, to_plain_dicts(observation))


def kept(plans: Plan, executed: int | None) -> Array | None:
    """What is known of past states when the next plans are made, `[B, K, D]`.

    Of those that were seen while a plan of several actions was executed nothing is.
    """
    single = executed == 1 or plans.actions.shape[1] == 1
    return plans.encoded[:, 1:] if single and plans.encoded is not None else None


def stack_contexts(histories: Sequence[History]) -> Context:
    """The contexts of B episodes, leaves with a leading `[B]`."""
    contexts = [history.context() for history in histories]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *contexts)


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
    """Plays one episode per level seed, all in lockstep, replanning when a plan is used up.

    Finished episodes leave the batch; one whose plan ends before its first action has given
    up. A plan's randomness derives from (seed, level seed, replan index), so an episode plays
    the same way whatever else is in the batch.

    Args:
        make_adapter: makes one environment; called once per episode.
        seeds: level seeds.
        plan: from `compile_planner`.
        params: of the energy.
        context: K.
        seed: of the planner's randomness.
        executed: actions to execute before replanning; None for all T.
        iteration: execute the plan as it stood after this many iterations; None: the last.
        max_steps: cut an episode off after so many; None: only the environment ends it.
        progress: called with (episodes over, successes) after every round.

    Raises:
        ValueError: nothing to play or to execute, an iteration that there is not, environments
            that are one and the same, or that have other actions than the planner, or
            observations that are not all of one shape.
        NotANumber: see `CompiledPlanner`.
    """
    check_limits(executed, max_steps)
    begun = time.perf_counter()
    adapters = [make_adapter() for _ in seeds]
    _check_adapters(adapters, plan)
    eager = {i: adapter for i, adapter in enumerate(adapters) if isinstance(adapter, Eager)}
    end = plan.num_actions - 1
    histories = [
        History(adapter.reset(int(s)), context, end + 1)
        for adapter, s in zip(adapters, seeds, strict=True)
    ]
    successes, scores = np.zeros(len(seeds), bool), np.zeros(len(seeds))
    active = list(range(len(seeds)))
    planned, planning_seconds, replan = 0, 0.0, 0
    while active:
        before = time.perf_counter()
        episodes = np.array([seeds[i] for i in active], np.uint32)
        keys = plan_keys(seed, episodes, np.full(len(active), replan, np.uint32))
        plans = plan(params, keys, stack_contexts([histories[i] for i in active]))
        if iteration is not None and not 1 <= iteration <= plans.trace.shape[1]:
            raise ValueError(f"iteration {iteration} is not in 1 .. {plans.trace.shape[1]}")
        chosen = plans.actions if iteration is None else plans.trace[:, iteration - 1]
        actions = np.asarray(chosen)[:, :executed]  # [B, executed]
        planning_seconds += time.perf_counter() - before
        planned += len(active)
        encoded = kept(plans, executed)
        for row, episode in enumerate(active):
            if episode in eager and actions[row, 0] < end:
                eager[episode].begin(int(actions[row, 0]))
        survivors = []
        for row, episode in enumerate(active):
            over = actions[row, 0] >= end
            for action in actions[row]:
                if action >= end:  # or MASK, of a plan that is executed before it is complete
                    break
                transition = adapters[episode].step(int(action))
                scores[episode] += transition.counted
                histories[episode].advance(
                    transition.executed(int(action)), transition.observation, transition.reward,
                    None if encoded is None else encoded[row],
                )  # fmt: skip
                too_long = max_steps is not None and histories[episode].step >= max_steps
                over = transition.terminated or transition.truncated or too_long
                if over:
                    successes[episode] = transition.success
                    break
            if not over:
                survivors.append(episode)
        active = survivors
        replan += 1
        progress(len(seeds) - len(active), int(successes.sum()))
    return Episodes(
        np.asarray(seeds),
        successes,
        np.array([history.step for history in histories]),
        scores,
        planned,
        planning_seconds,
        time.perf_counter() - begun,
    )
