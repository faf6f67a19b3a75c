"""Environments as the rollout sees them: the `Adapter` protocol, and Gymnasium's."""

import contextlib
import inspect
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from leapjax.checks import check_number
from leapjax.errors import UserError
from leapjax.types import Array, PyTree, to_plain_dicts

if TYPE_CHECKING:
    import gymnasium as gym

A = TypeVar("A", bound="Adapter")


class Transition(NamedTuple):
    """What one environment step gave."""

    observation: PyTree
    reward: float  # as demonstrations have it, since planners see it
    terminated: bool
    truncated: bool
    success: bool  # by the environment's own measure
    score: float | None = None  # what counts in the end, where that is not the reward
    taken: int | None = None  # the action that was executed, where it is another than asked for

    def executed(self, action: Array) -> Array:
        """What was done when `action` was asked for."""
        return action if self.taken is None else self.taken

    @property
    def counted(self) -> float:
        """What it adds to an episode's return as reported."""
        return self.reward if self.score is None else self.score


class Adapter(Protocol):
    """One environment with discrete actions `0 .. A - 2`; the rollout keeps `A - 1`, end.

    An observation is any pytree of NumPy arrays whose shapes never change. An adapter whose
    environment works on its own may be `Eager`; one whose environment holds files, ports or
    processes should be `Closable`.
    """

    num_actions: int  # A, the end action included

    def reset(self, seed: int) -> PyTree:
        """Starts the episode of a seed and returns its first observation."""
        ...

    def step(self, action: int) -> Transition:
        """Takes one action."""
        ...


@runtime_checkable
class Eager(Protocol):
    """An `Adapter` whose environment works on its own, so that many can work at once."""

    def begin(self, action: int) -> None:
        """Begins to take an action; the next `step`, with the same one, waits for what it gives."""
        ...


class Criterion(NamedTuple):
    """When an episode succeeds, in an environment that has no measure of success of its own.

    Attributes:
        least_return: that the episode has to reach; None: it has to terminate with a positive
            reward.
        given: whether the user gave it; if not, it is the environment's `reward_threshold`.
    """

    least_return: float | None
    given: bool = False

    def __str__(self) -> str:
        """In words, with where it comes from."""
        if self.least_return is None:
            return "a positive reward at the end (nobody has named a return)"
        origin = "given"
        if not self.given:
            origin = "reward_threshold of the environment, meant for the mean over episodes"
        return f"a return of at least {self.least_return:g} ({origin})"


def find_criterion(env: "gym.Env", success_return: float | None = None) -> Criterion:
    """Chooses when an episode of an environment succeeds.

    Args:
        env: whose authors may ask for a return (`reward_threshold`).
        success_return: that the user asks for; None: what the authors ask for.

    Raises:
        UserError: `success_return` is not a finite number.
    """
    if success_return is not None:
        return Criterion(check_number("success_return", success_return), given=True)
    return Criterion(env.spec.reward_threshold if env.spec is not None else None)


def judge_episode(
    criterion: Criterion, total: float, reward: float, terminated: bool, truncated: bool
) -> bool:
    """Says whether an episode has succeeded so far.

    Args:
        criterion: to judge by.
        total: the episode's return so far.
        reward: of its last step.
        terminated: with its last step.
        truncated: with its last step.
    """
    if criterion.least_return is None:
        return bool(terminated and reward > 0)
    # A positive return may be reached before the end, and the planner may stop there. A return of
    # 0 or less holds from the start, so only the end shows whether it is kept.
    over = terminated or truncated or criterion.least_return > 0
    return bool(over and total >= criterion.least_return)


@runtime_checkable
class Closable(Protocol):
    """An `Adapter` whose environment holds something that must be given back."""

    def close(self) -> None:
        """Gives it back; the adapter is not played again."""
        ...


def close(adapter: Adapter) -> None:
    """Closes an adapter if it is `Closable`."""
    if isinstance(adapter, Closable):
        adapter.close()


@contextlib.contextmanager
def closing(adapter: A) -> Iterator[A]:
    """Yields an adapter and closes it, also after an error, which a failing `close` never hides."""
    try:
        yield adapter
    except BaseException:
        with contextlib.suppress(Exception):
            close(adapter)
        raise
    close(adapter)


def list_environments(adapter: Adapter) -> list[object]:
    """The Gymnasium environments that an adapter steps, without their wrappers.

    Finds attributes of the adapter, of its class, and of other adapters inside it. Lists are not
    searched: a list of environments that all adapters know says nothing of which one is stepped.
    """
    gymnasium = sys.modules.get("gymnasium")
    if gymnasium is None:  # not imported, so nothing can be one of its environments
        return []
    kinds = (gymnasium.Env, gymnasium.vector.VectorEnv)
    found: list[object] = []
    owners: list[Any] = [adapter]
    for owner in owners:
        for part in _list_attributes(owner):
            if isinstance(part, kinds):
                found.append(part.unwrapped)
            elif callable(getattr(part, "step", None)) and id(part) not in map(id, owners):
                owners.append(part)
    return found


def _describe_returned(found: Any) -> str:
    """What a step returned, in a message."""
    return f"{len(found)} values" if isinstance(found, tuple) else type(found).__name__


def _list_attributes(owner: object) -> list[Any]:
    """The attributes of an object and of its class; not what containers among them hold."""
    kinds = type(owner).__mro__
    found = [part for place in (*kinds, owner) for part in getattr(place, "__dict__", {}).values()]
    slots = filter(inspect.ismemberdescriptor, found)  # which no `__dict__` of an object has
    return [*found, *(getattr(owner, slot.__name__, None) for slot in slots)]


class GymnasiumAdapter:
    """Any Gymnasium environment with discrete actions.

    An episode succeeds when its return reaches `success_return`. If that is None, the return is
    the environment's `reward_threshold`. If there is none either, an episode succeeds when it
    terminates with a positive reward.
    """

    def __init__(self, env: "gym.Env", success_return: float | None = None) -> None:
        actions = getattr(env, "action_space", None)
        if actions is None:
            raise UserError(
                f"expected a Gymnasium environment, such as gymnasium.make returns, got {env!r}"
            )
        gymnasium = sys.modules.get("gymnasium")  # imported, if this is one of its environments
        if gymnasium is None or not isinstance(actions, gymnasium.spaces.Discrete):
            raise ValueError(f"a Discrete action space is needed, got {actions}")
        self.env = env
        self.num_actions = int(actions.n) + 1
        self._first_action = int(actions.start)
        self.criterion = find_criterion(env, success_return)
        self._return = 0.0

    def reset(self, seed: int) -> PyTree:
        """Starts the episode of a seed."""
        self._return = 0.0
        found = self.env.reset(seed=seed)
        if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], dict)):
            raise TypeError(
                f"reset of {self.env} returned {type(found).__name__}, not (observation, info): "
                "it is of Gym's old interface; wrap it for Gymnasium"
            )
        return to_plain_dicts(found[0])

    def step(self, action: int) -> Transition:
        """Takes one action."""
        found = self.env.step(self._first_action + action)
        if not (isinstance(found, tuple) and len(found) == 5):
            raise UserError(
                f"step of {self.env} returned {_describe_returned(found)}, not (observation, "
                "reward, terminated, truncated, info): wrap it for Gymnasium"
            )
        observation, reward, terminated, truncated, _ = found
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            raise UserError(f"step of {self.env} gave a reward of {reward!r}, no number") from None
        self._return += reward
        success = judge_episode(self.criterion, self._return, reward, terminated, truncated)
        return Transition(to_plain_dicts(observation), reward, terminated, truncated, success)

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()
