"""Checks that a data set was recorded in the environment that is played."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from leapjax.domain import Described
from leapjax.errors import UserError

UNBOUNDED = 2.0**31 - 1  # from here on bounds count as infinite; Gymnasium's versions differ
# Wrappers of Gymnasium that change neither observations, nor rewards, nor actions.
WATCHING = frozenset(
    {
        "AddWhiteNoise", "HumanRendering", "ObstructView", "OrderEnforcing", "PassiveEnvChecker",
        "RecordEpisodeStatistics", "RecordVideo", "RenderCollection", "TimeLimit",
    }
)  # fmt: skip


def describe_environment(env: gym.Env) -> Described:
    """Describes an environment in the form of a data set's metadata."""
    spaces = {"observation": env.observation_space, "action": env.action_space}
    if env.spec is None:
        return Described(spaces=spaces)
    return Described(
        level=env.spec.id,
        arguments=_read_arguments(env.spec),
        wrappers=[
            {"name": each.name, "entry_point": each.entry_point, "kwargs": _as_json(each.kwargs)}
            for each in env.spec.additional_wrappers
        ],
        max_steps=env.spec.max_episode_steps,
        spaces=spaces,
    )


def _read_arguments(spec: gym.envs.registration.EnvSpec) -> Mapping[str, Any] | None:
    """Reads an environment's arguments as a data set stores them; `None` if they are not JSON."""
    try:
        return json.loads(spec.to_json())["kwargs"]
    except Exception:  # noqa: BLE001  (arguments that are not JSON raise many kinds)
        return None


def check_environment(recorded: Described, where: str, played: Described) -> None:
    """Checks that a data set was recorded in the environment that is played.

    It does not rebuild the data set's wrappers: a data set could then choose the imported code.

    Args:
        recorded: description of the data set's environment.
        where: name of the data set, for the message.
        played: description of the played environment; `max_steps` is `None` if the user chose it.

    Raises:
        UserError: names the arguments, wrappers, step limit or space that differs.
    """
    level = played.level
    _check_arguments(recorded, where, played)
    if recorded.wrappers is not None and played.wrappers is not None:
        theirs, ours = _select_changing(recorded.wrappers), _select_changing(played.wrappers)
        if theirs != ours:
            raise UserError(
                f"{where} was recorded with {_list_wrappers(theirs)}, and {level} is played with "
                f"{_list_wrappers(ours)}: write a module that registers {level} with the wrappers "
                f"of the data (gymnasium.register, additional_wrappers), and play MODULE:{level}"
            )
    if None not in (recorded.max_steps, played.max_steps) and (
        recorded.max_steps != played.max_steps
    ):
        raise UserError(
            f"{where} was recorded with episodes of at most {recorded.max_steps} steps, and "
            f"{level} ends them after {played.max_steps}: choose one as max_steps"
        )
    for part, space in played.spaces.items():
        if part in recorded.spaces:
            _check_space(recorded.spaces[part], space, part, where, level)


def _check_arguments(recorded: Described, where: str, played: Described) -> None:
    """Checks that both environments have the same arguments; `render_mode` may differ.

    Raises:
        UserError: they differ; says how to play with the arguments of the data.
    """
    if recorded.arguments is None or played.arguments is None:
        return
    theirs, ours = (
        {key: value for key, value in each.items() if key != "render_mode"}
        for each in (recorded.arguments, played.arguments)
    )
    if theirs != ours:
        raise UserError(
            f"{where} was recorded in {played.level} with other arguments than it is played with: "
            f"give it {json.dumps(theirs)}",
            "arguments",
        )


def _select_changing(wrappers: Sequence[Mapping[str, Any]]) -> list[tuple[Any, Any]]:
    """Selects the wrappers that change observations, rewards or actions: name and arguments."""
    return [
        (each.get("name"), each.get("kwargs"))
        for each in wrappers
        if not (
            str(each.get("entry_point")).startswith("gymnasium.wrappers")
            and each.get("name") in WATCHING
        )
    ]


def _list_wrappers(wrappers: Sequence[tuple[Any, Any]]) -> str:
    names = [f"{name} {json.dumps(kwargs)}" if kwargs else str(name) for name, kwargs in wrappers]
    return f"the wrappers {', '.join(names)}" if names else "no wrappers"


def _as_json(value: Any) -> Any:
    """Converts a value to JSON and back; values that JSON does not have become their `repr`."""

    def convert(other: Any) -> Any:
        return other.tolist() if isinstance(other, np.ndarray | np.generic) else repr(other)

    try:
        return json.loads(json.dumps(value, default=convert))
    except (TypeError, ValueError, RecursionError):  # keys that are not strings, or a cycle
        return repr(value)


def _check_space(
    recorded: gym.Space, played: gym.Space, part: str, where: str, level: str | None
) -> None:
    """Checks that two spaces hold the same values; data may have additional parts.

    Raises:
        UserError: names the part that differs.
    """
    both = gym.spaces.Dict
    if isinstance(recorded, both) and isinstance(played, both):
        for key in played.spaces.keys() & recorded.spaces.keys():
            _check_space(recorded[key], played[key], f"{part}[{key!r}]", where, level)
    elif not _is_same(recorded, played):
        raise UserError(
            f"{where} says that each {part} is in {recorded}, and in {level} it is in {played}: "
            "play the environment that the data were recorded in, its version, arguments and "
            "wrappers included"
        )


def _is_same(recorded: Any, played: Any) -> bool:
    """Returns whether two spaces hold the same values; their number types may differ."""
    if type(recorded) is not type(played) or recorded.shape != played.shape:
        return False
    if isinstance(played, gym.spaces.Box):
        return np.allclose(_bounds(recorded), _bounds(played))
    if isinstance(played, gym.spaces.Discrete):
        return (recorded.start, recorded.n) == (played.start, played.n)
    if isinstance(played, gym.spaces.MultiDiscrete):
        pairs = ((recorded.start, played.start), (recorded.nvec, played.nvec))
        return all(np.array_equal(*pair) for pair in pairs)
    return True


def _bounds(space: gym.spaces.Box) -> np.ndarray:
    bounds = np.stack([space.low, space.high]).astype(np.float64)
    return np.where(np.abs(bounds) >= UNBOUNDED, np.copysign(np.inf, bounds), bounds)
