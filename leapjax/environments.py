"""How a rollout sees environments: the `Adapter` protocol, and an adapter of Gymnasium."""

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
    """The result of one environment step.

    Attributes:
        observation: the observation after the step.
        reward: the reward, on the scale of demonstrations: planners see it.
        terminated: whether the episode came to an end of its own.
        truncated: whether the episode was cut off, for instance by a step limit.
        success: whether the episode has succeeded, by the environment's own measure.
        score: the step's part of the reported return; `None` for the reward.
        taken: the action that was executed; `None` for the requested action.
    """

    observation: PyTree
    reward: float
    terminated: bool
    truncated: bool
    success: bool
    score: float | None = None
    taken: int | None = None

    def executed(self, action: Array) -> Array:
        """Returns the action that was executed when `action` was requested."""
        return action if self.taken is None else self.taken

    @property
    def counted(self) -> float:
        """The step's part of the reported return of its episode."""
        return self.reward if self.score is None else self.score


class Adapter(Protocol):
    """One environment with discrete actions `0 .. A - 2`; it never gets the end action, `A - 1`.

    An observation is any pytree of NumPy arrays whose shapes never change. An adapter may be
    `Eager` if its environment works in the background. It should be `Closable` if its environment
    holds files, ports or processes.

    Attributes:
        num_actions: A, the end action included.
    """

    num_actions: int

    def reset(self, seed: int) -> PyTree:
        """Starts the episode of a seed and returns its first observation."""
        ...

    def step(self, action: int) -> Transition:
        """Takes one action."""
        ...


@runtime_checkable
class Eager(Protocol):
    """An `Adapter` whose environment steps in the background, so that many can step at once."""

    def begin(self, action: int) -> None:
        """Starts to take an action; the next `step`, with the same action, waits for its result."""
        ...


class Criterion(NamedTuple):
    """When an episode succeeds, for environments without their own measure of success.

    Attributes:
        least_return: return that the episode must reach. `None`: the episode must terminate with a
            positive reward.
        given: whether the user chose this return; if not, it is the environment's
            `reward_threshold`.
    """

    least_return: float | None
    given: bool = False

    def __str__(self) -> str:
        """Describes the criterion and its origin in words."""
        if self.least_return is None:
            return "a positive reward at the end (nobody has named a return)"
        origin = "given"
        if not self.given:
            origin = "reward_threshold of the environment, meant for the mean over episodes"
        return f"a return of at least {self.least_return:g} ({origin})"


def find_criterion(env: "gym.Env", success_return: float | None = None) -> Criterion:
    """Chooses when an episode of an environment succeeds.

    Args:
        env: environment, whose specification may have a `reward_threshold`.
        success_return: return that the user asks for; `None` for the `reward_threshold`.

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
        criterion: criterion of success.
        total: return of the episode so far.
        reward: reward of the last step.
        terminated: whether the last step terminated the episode.
        truncated: whether the last step truncated the episode.
    """
    if criterion.least_return is None:
        return bool(terminated and reward > 0)
    # A positive return may be reached before the end, and the planner may stop there. A return of
    # 0 or less holds from the start, so only the end shows whether it is kept.
    over = terminated or truncated or criterion.least_return > 0
    return bool(over and total >= criterion.least_return)


@runtime_checkable
class Closable(Protocol):
    """An `Adapter` whose environment holds resources that must be released."""

    def close(self) -> None:
        """Releases the resources; the adapter is not played again."""
        ...


def close(adapter: Adapter) -> None:
    """Closes an adapter if it is `Closable`."""
    if isinstance(adapter, Closable):
        adapter.close()


@contextlib.contextmanager
def closing(adapter: A) -> Iterator[A]:
    """Yields an adapter and closes it. A failing `close` never hides an earlier error."""
    try:
        yield adapter
    except BaseException:
        with contextlib.suppress(Exception):
            close(adapter)
        raise
    close(adapter)


def list_environments(adapter: Adapter) -> list[object]:
    """Lists the Gymnasium environments that an adapter steps, without their wrappers.

    Searches the attributes of the adapter, of its class, and of other adapters inside it. Lists are
    not searched: adapters may share a list of environments, and each step its own.
    """
    gymnasium = sys.modules.get("gymnasium")
    if gymnasium is None:  # not imported, so it has no environments yet
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
    """Describes the return value of a step, for a message."""
    return f"{len(found)} values" if isinstance(found, tuple) else type(found).__name__


def _list_attributes(owner: object) -> list[Any]:
    """Lists attributes of an object and of its class, but not the contents of containers."""
    kinds = type(owner).__mro__
    found = [part for place in (*kinds, owner) for part in getattr(place, "__dict__", {}).values()]
    slots = filter(inspect.ismemberdescriptor, found)  # not in the object's `__dict__`
    return [*found, *(getattr(owner, slot.__name__, None) for slot in slots)]


class GymnasiumAdapter:
    """Any Gymnasium environment with discrete actions.

    An episode succeeds if it ends with a return of at least `success_return` or, by default, the
    environment's `reward_threshold`. Without either, it succeeds when it terminates with a positive
    reward.

    Args:
        env: a Gymnasium environment.
        success_return: return that counts as success; `None` for the default.

    Raises:
        UserError: `env` is not an environment, or `success_return` is not a finite number.
        ValueError: the action space is not `Discrete`.
    """

    def __init__(self, env: "gym.Env", success_return: float | None = None) -> None:
        actions = getattr(env, "action_space", None)
        if actions is None:
            raise UserError(
                f"expected a Gymnasium environment, such as gymnasium.make returns, got {env!r}"
            )
        gymnasium = sys.modules.get("gymnasium")  # already imported, if `env` is from there
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
