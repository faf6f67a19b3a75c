"""Any Gymnasium environment with discrete actions as a `Domain`, with data from Minari."""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable
from typing import Any, TypeVar

import gymnasium as gym
import jax
import numpy as np

from leapjax.checks import check_at_least, check_fits, check_types
from leapjax.domain import Demonstrations, Domain, DomainType, Encoders, Scaling, Statistics
from leapjax.domains.gymnasium.observations import (
    StateTokens,
    blank_of,
    check_choices,
    check_precision,
    check_statistics,
    measure_parts,
    parts_of,
)
from leapjax.domains.gymnasium.recorded import check_environment, describe_environment
from leapjax.environments import GymnasiumAdapter, Transition, find_criterion
from leapjax.errors import UserError, did_you_mean, first_line
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.types import PyTree

R = TypeVar("R")
EXAMPLES = ("CartPole-v1",)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of an environment.

    Attributes:
        success_return: Return that an episode must reach to count as a success; by default the
            environment's own `reward_threshold`. Without either, an episode succeeds if it
            terminates with a positive reward.
        max_steps: Steps after which an episode is cut off; by default the limit of the environment.
        arguments: Keyword arguments of `gymnasium.make`, as a JSON object.
    """

    success_return: float | None = None
    max_steps: int | None = None
    arguments: str = "{}"

    def __post_init__(self) -> None:
        check_types(self)
        if self.max_steps is not None:
            check_at_least(self, 1, "max_steps")
        try:
            wrong = not isinstance(json.loads(self.arguments), dict)
        except (ValueError, RecursionError):
            wrong = True
        if wrong:
            like = '{"size": 8}'
            raise ValueError(
                f"arguments must be a JSON object like {like}, got {self.arguments[:100]}"
            )


class CheckedAdapter(GymnasiumAdapter):
    """Adapts a user's environment, and turns its errors into one-line `UserError`s."""

    def __init__(
        self, env: gym.Env, name: str, blank: PyTree, success_return: float | None
    ) -> None:
        super().__init__(env, success_return)
        self._name, self._blank = name, blank
        self._shapes = jax.tree.map(np.shape, blank)

    def reset(self, seed: int) -> PyTree:
        """Starts the episode of a seed."""
        return self._check(self._guard("reset", lambda: super(CheckedAdapter, self).reset(seed)))

    def step(self, action: int) -> Transition:
        """Takes one action."""
        found = self._guard("step", lambda: super(CheckedAdapter, self).step(action))
        return found._replace(observation=self._check(found.observation))

    def close(self) -> None:
        """Closes the environment."""
        self._guard("close", super().close)

    def _guard(self, what: str, work: Callable[[], R]) -> R:
        try:
            return work()
        except UserError:
            raise
        except Exception as error:  # the user's code may raise anything
            raise UserError(
                f"{what} of {self._name} raised {type(error).__name__}: {first_line(error)}"
            ) from error

    def _check(self, observation: Any) -> PyTree:
        shapes = jax.tree.map(np.shape, observation)
        if shapes != self._shapes:
            raise UserError(
                f"{self._name} gave an observation of shape {shapes}; its observation space says "
                f"{self._shapes}"
            )
        where = f"an observation of {self._name}"

        def narrow_part(path: Any, values: Any, like: np.ndarray) -> np.ndarray:
            return check_fits(f"{where}{jax.tree_util.keystr(path)}", values, like.dtype)

        narrow = jax.tree.map_with_path(narrow_part, observation, self._blank)
        check_choices(self.env.observation_space, narrow, where)
        return narrow


def make_environment(name: str, options: Settings) -> gym.Env:
    """Makes an environment by its id, or by `module:id`, cut off after `max_steps`.

    Raises:
        UserError: the environment cannot be made, or an episode may never end.
    """
    try:
        env = gym.make(name, options.max_steps, **json.loads(options.arguments))
    except Exception as error:  # noqa: BLE001  (it is the user's code)
        raise UserError(
            f"the environment {name!r} cannot be made: {_explain(name, error)}"
        ) from None
    if _read_limit(env) is None:
        with contextlib.suppress(Exception):
            env.close()
        raise UserError(
            f"{name} has no limit of steps, so an episode may never end: give it one",
            "max_steps",
        )
    return env


def _explain(name: str, error: Exception) -> str:
    """Explains why an environment cannot be made; proposes a remedy for known errors."""
    module, _, short = name.rpartition(":")
    register = "" if module else f"; if a module registers it, give MODULE:{name}"
    if ":" in module:
        return "expected its id, or MODULE:ID"
    if isinstance(error, gym.error.NameNotFound):
        return f"no {short!r} is registered{register}{did_you_mean(short, gym.registry)}"
    if isinstance(error, gym.error.NamespaceNotFound):
        namespace = short.partition("/")[0]
        return f"no {namespace}/ is registered: install the package that has it{register}"
    if isinstance(error, ModuleNotFoundError):  # Gymnasium's own error wraps Python's
        missing = error.name or getattr(error.__cause__, "name", None)
        if missing:
            return f"no module {missing!r}: install it, or put its folder on PYTHONPATH"
    return first_line(error)


def _read_limit(env: gym.Env) -> int | None:
    return env.spec.max_episode_steps if env.spec is not None else None


def make(name: str, options: Settings) -> Domain:
    """Makes the domain of an environment by id; makes the environment once, to read its spaces.

    Raises:
        UserError: the environment cannot be made, or its spaces cannot be used.
    """
    env = make_environment(name, options)
    try:
        return _describe(env, name, options)
    finally:
        with contextlib.suppress(Exception):  # only its spaces were read
            env.close()


def _describe(env: gym.Env, name: str, options: Settings) -> Domain:
    """Describes an environment as a domain."""
    actions = env.action_space
    if not isinstance(actions, gym.spaces.Discrete) or actions.start != 0:
        raise UserError(f"{name} has actions {actions}: expected Discrete(n), counted from 0")
    space = env.observation_space
    played = describe_environment(env)
    if options.max_steps is not None:  # the user has chosen a limit
        played = played._replace(max_steps=None)
    blank, parts = blank_of(space, f"the observation of {name}"), parts_of(space)

    def check(observations: PyTree, where: str) -> None:
        check_choices(space, observations, where)
        check_precision(space, observations, where)

    def make_encoders(statistics: Statistics) -> Encoders:
        def tokens(num_actions: int, model: ModelConfig, sizes: Sizes) -> Encoder:
            del sizes
            return StateTokens(parts, model.width, num_actions, model.dtype, statistics)

        return {
            "paper": functools.partial(tokens, 0),  # its network embeds actions itself
            "leapjax": functools.partial(tokens, int(actions.n) + 1),
        }

    def scale_encoders(statistics: Statistics) -> Encoders:
        check_statistics(statistics, parts, blank)
        return make_encoders(statistics)

    return Domain(
        level=name,
        make_adapter=lambda: CheckedAdapter(
            make_environment(name, options), name, blank, options.success_return
        ),
        actions=(*(str(action) for action in range(actions.n)), "end"),
        max_steps=_read_limit(env) or 0,
        blank=blank,
        encoders=make_encoders(()),
        demonstrations=Demonstrations(
            check=check,
            check_environment=functools.partial(check_environment, played=played),
            criterion=find_criterion(env, options.success_return),
        ),
        scaling=Scaling(measure=functools.partial(measure_parts, parts), encoders=scale_encoders),
        signature={"parts": [list(part) for part in parts]},
    )


GYMNASIUM = DomainType(Settings, make, EXAMPLES)
