"""Checks an episode against a domain: shapes, types and ranges of numbers."""

from typing import Any

import jax
import numpy as np

from leapjax.checks import MOST, check_fits, check_flag, check_integer, check_range
from leapjax.data.storage.datasets import UNKNOWN_SEED
from leapjax.data.storage.spaces import name_parts
from leapjax.domain import Domain
from leapjax.errors import UserError
from leapjax.types import Demonstration, PyTree

STEPWISE = ("actions", "rewards", "terminations", "truncations")  # one element per step


def check_outline(outline: PyTree, domain: Domain, where: str) -> None:
    """Checks the shapes and types of an episode's arrays before they are read.

    Raises:
        UserError: arrays are missing, or their shapes contradict each other or the domain.
    """
    for part in ("observations", *STEPWISE):
        if part not in outline:
            raise UserError(f"{where} has no {part}")
    steps = _check_numbers(np.zeros((), np.int64), outline["actions"], f"{where}: actions").shape
    if len(steps) != 1:
        raise UserError(f"{where}: actions have shape {steps}, expected one per step")
    if steps == (0,):
        raise UserError(f"{where} has no actions")
    for part in STEPWISE[1:]:
        if np.shape(outline[part]) != steps:
            raise UserError(
                f"{where}: {part} have shape {np.shape(outline[part])}, expected {steps}"
            )
    stored = outline["observations"]
    # A domain with `replay` replays episodes that have other observations.
    if domain.demonstrations.replay is None or _holds_fields(domain.blank, stored):
        observations = _arrange_like(domain.blank, stored, where)
        _check_shapes(observations, domain, steps[0] + 1, where)


def _holds_fields(blank: PyTree, stored: Any) -> bool:
    """Returns whether stored observations have all fields of a domain's observations."""
    dictionaries = isinstance(stored, dict) and not isinstance(blank, np.ndarray)
    return dictionaries and set(name_parts(blank)) <= set(stored)


def check_demonstration(given: Demonstration, domain: Domain, where: str) -> Demonstration:
    """Returns a demonstration in the types that a domain's network reads.

    Args:
        given: one episode.
        domain: the level that the episode should come from.
        where: name of the episode in messages.

    Raises:
        UserError: the domain lacks an action; observations or rewards have other shapes or types;
            or numbers are out of range.
    """
    actions, rewards = check_actions(given.actions, where), check_rewards(given.rewards, where)
    check_range(f"{where}: actions", actions, 0, domain.num_actions - 2)
    if rewards.shape != actions.shape:
        raise UserError(f"{where}: rewards of shape {rewards.shape}, actions of {actions.shape}")
    terminated, truncated = (
        check_flag(f"{where}: {name}, one flag an episode,", getattr(given, name))
        for name in ("terminated", "truncated")
    )
    check_integer(f"{where}: seed", given.seed, UNKNOWN_SEED, 2**64 - 1)
    observations = _arrange_like(domain.blank, given.observations, where)
    _check_shapes(observations, domain, len(actions) + 1, where)
    domain.demonstrations.check(observations, where)

    def narrowed(path: Any, values: np.ndarray, like: np.ndarray) -> np.ndarray:
        name = jax.tree_util.keystr(path, simple=True) or "observations"
        return check_fits(f"{where}: {name}", values, like.dtype)

    return given._replace(
        observations=jax.tree.map_with_path(narrowed, observations, domain.blank),
        actions=actions.astype(np.int32),
        rewards=rewards,
        terminated=terminated,
        truncated=truncated,
    )


def check_actions(values: Any, where: str) -> np.ndarray:
    """Returns the actions `[n]` of an episode in their stored type; n > 0.

    Raises:
        UserError: the actions are not integers of at least 0, with one per step.
    """
    actions = _check_numbers(np.zeros((), np.int64), values, f"{where}: actions")
    if actions.ndim != 1 or not actions.size:
        raise UserError(f"{where}: actions have shape {actions.shape}, expected one per step")
    if actions.min() < 0 or actions.max() > MOST:
        raise UserError(
            f"{where}: actions run from {actions.min()} to {actions.max()}, expected 0 or more"
        )
    return actions


def check_rewards(values: Any, where: str) -> np.ndarray:
    """Returns the rewards of an episode as float32.

    Raises:
        UserError: the rewards are not numbers, or float32 cannot represent them.
    """
    rewards = _check_numbers(np.zeros((), np.float32), values, f"{where}: rewards")
    return check_fits(f"{where}: rewards", rewards, np.dtype(np.float32))


def read_mark(marks: Any, what: str) -> bool:
    """Returns whether an episode ended with its last step, given a mark `[n]` for each step.

    Raises:
        UserError: a mark is neither true nor false, or says that an earlier step was the last.
    """
    values = np.asarray(marks)
    if values.dtype.kind not in "biuf" or not np.isin(values, (0, 1)).all():
        raise UserError(f"{what} must be true or false")
    if values[:-1].any():
        step = int(np.argmax(values != 0))
        raise UserError(
            f"{what} say that the episode ended with step {step}, and it goes on to step "
            f"{len(values) - 1}: split it there"
        )
    return bool(values[-1])


def _arrange_like(blank: PyTree, stored: Any, where: str, name: str = "observations") -> PyTree:
    """Returns stored observations in the structure of `blank` and in their stored types.

    Raises:
        UserError: a field is missing, or has another kind of numbers.
    """
    if isinstance(blank, np.ndarray):
        return _check_numbers(blank, stored, f"{where}: {name}")
    stored = stored._asdict() if hasattr(stored, "_asdict") else stored
    parts = name_parts(blank)
    missing = [part for part in parts if not isinstance(stored, dict) or part not in stored]
    if missing:
        raise UserError(
            f"{where} has no observation {missing[0]!r}: "
            f"expected a dictionary of {', '.join(parts)}"
        )
    values = {part: _arrange_like(x, stored[part], where, part) for part, x in parts.items()}
    return type(blank)(**values)


def _check_numbers(blank: np.ndarray, values: Any, what: str) -> np.ndarray:
    """Returns values as an array of the kind of `blank`: booleans, integers or real numbers.

    Raises:
        UserError: the values are of another kind.
    """
    array = np.asarray(values)
    if blank.dtype == bool:
        if array.dtype != bool:
            raise UserError(f"{what} must be true or false, got {array.dtype}")
        return array
    if np.issubdtype(blank.dtype, np.integer):
        if not np.issubdtype(array.dtype, np.integer):
            raise UserError(f"{what} must be integers, got {array.dtype}")
        return array
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise UserError(f"{what} must be numbers, got {array.dtype}")
    return array


def _check_shapes(observations: PyTree, domain: Domain, states: int, where: str) -> None:
    """Checks that observations of `states` states have the shapes of a domain.

    Raises:
        UserError: names the field that has another shape.
    """
    found = jax.tree.leaves(observations)
    for (path, blank), array in zip(jax.tree.leaves_with_path(domain.blank), found, strict=True):
        name = jax.tree_util.keystr(path, simple=True) or "observations"
        if array.shape != (states, *blank.shape):
            raise UserError(
                f"{where}: {name} has shape {array.shape}, level {domain.level} needs "
                f"{(states, *blank.shape)}"
            )
