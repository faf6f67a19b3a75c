"""Reads the demonstrations of a Minari data set, this library's or a user's own."""

import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import minari
import numpy as np
from minari.dataset.episode_data import EpisodeData
from minari.storage.datasets_root_dir import get_dataset_path

from leapjax import files
from leapjax.checks import check_integer
from leapjax.data.storage.datasets import (
    FORMAT,
    UNKNOWN_SEED,
    describe_dataset,
    find_datasets_folder,
    find_version,
    has_dataset,
)
from leapjax.data.storage.episodes import (
    STEPWISE,
    check_actions,
    check_demonstration,
    check_outline,
    check_rewards,
    read_mark,
)
from leapjax.data.storage.inspection import has_jpeg_observations, inspect_dataset, read_metadata
from leapjax.data.storage.provenance import compare_with_play
from leapjax.data.storage.spaces import read_spaces
from leapjax.domain import Collection, Domain, Recording
from leapjax.errors import UserError, first_line
from leapjax.types import Demonstration, PyTree


def load(name: str, domain: Domain, most: int | None = None) -> Collection:
    """Reads the demonstrations of a Minari data set and checks them against a domain.

    Args:
        name: id of the data set.
        domain: the level that the data should come from. Its `replay`, if any, replays episodes
            with other observations. `load` drops the episodes that it cannot use.
        most: maximal number of demonstrations; `None` for all.

    Raises:
        UserError: the data set is missing, damaged or empty, or does not fit the domain.
    """
    if not has_dataset(name):
        raise UserError(
            f"no Minari data set {name!r} in {find_datasets_folder()}: "
            "check the id with `minari list local`"
        )
    version = find_version(name)
    if version is not None and version < FORMAT:
        raise UserError(
            f"the data set {name!r} is of an earlier version, which kept no rewards: make it "
            "anew, as a run does that names no data set",
            "demonstrations",
        )
    folder = get_dataset_path(name) / "data"
    with _explain_damage(name):
        metadata = read_metadata(folder)
        outlines = inspect_dataset(folder, metadata)
        recorded = describe_dataset(name)._replace(spaces=read_spaces(metadata, domain))
        domain.demonstrations.check_environment(recorded, f"the Minari data set {name!r}")
    for index, outline in enumerate(outlines):
        check_outline(outline, domain, _name_episode(index, name))
    with _explain_damage(name):
        _check_total(metadata, outlines)
    _check_memory(name, outlines[:most], domain)
    found: list[Demonstration] = []
    dropped: Counter[str] = Counter()
    for episode, seed in _read_episodes(name):
        if most is not None and len(found) >= most:
            break
        result = _make_demonstration(episode, seed, domain, _name_episode(episode.id, name))
        if isinstance(result, str):
            dropped[result] += 1
        else:
            found.append(result)
    compare_with_play(name, recorded, domain, found, exact=not has_jpeg_observations(metadata))
    collection = Collection(found, dropped)
    if not found:
        described = describe_dropped(collection)
        only = f" that can be used, only {described}" if described else ""
        raise UserError(f"the Minari data set {name!r} has no episodes{only}")
    return collection


def describe_dropped(collection: Collection) -> str:
    """Describes how many episodes were dropped, for which reasons; empty if none was."""
    return ", ".join(f"{count} {reason}" for reason, count in collection.dropped.items() if count)


@contextlib.contextmanager
def _explain_damage(name: str) -> Iterator[None]:
    """Turns the exceptions of h5py and Minari into a UserError: the data set is damaged."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001
        again = "delete it and it is made again, or " if find_version(name) is not None else ""
        raise UserError(
            f"the Minari data set {name!r} cannot be read ({first_line(error)}): {again}restore it"
        ) from None


def _read_episodes(name: str) -> Iterator[tuple[EpisodeData, int]]:
    """Reads the episodes of an inspected data set, one by one, with the seeds of their resets.

    Raises:
        UserError: the data set is damaged.
    """
    with _explain_damage(name):
        dataset = minari.load_dataset(name)
        metadata = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
        for episode, details in zip(dataset.iterate_episodes(), metadata, strict=True):
            yield episode, _read_seed(details.get("seed"))


def _read_seed(value: Any) -> int:
    """Returns the seed of a reset, or `UNKNOWN_SEED` unless it is an integer of 64 bits.

    A data set stores 64 bits, so every demonstration can be stored again.
    """
    try:
        return check_integer("the seed of an episode", value, 0, 2**64 - 1)
    except UserError:
        return UNKNOWN_SEED


def _make_demonstration(
    episode: EpisodeData, seed: int, domain: Domain, where: str
) -> Demonstration | str:
    """Makes a demonstration of an episode, or says why the episode cannot be used."""
    actions = check_actions(episode.actions, where)
    rewards = check_rewards(episode.rewards, where)
    terminated, truncated = (
        read_mark(getattr(episode, marks), f"{where}: {marks}") for marks in STEPWISE[2:]
    )
    if domain.demonstrations.replay is not None:
        again = domain.demonstrations.replay(
            Recording(episode.observations, actions.astype(np.int64), rewards, seed)
        )
        if again is not None:
            return again
    found = Demonstration(episode.observations, actions, rewards, terminated, truncated, seed)
    return check_demonstration(found, domain, where)


def _check_total(metadata: dict[str, Any], outlines: Sequence[PyTree]) -> None:
    """Checks that the episodes together have as many steps as the metadata say.

    Raises:
        ValueError: the episodes have another number of steps.
    """
    steps = sum(len(outline["actions"]) for outline in outlines)
    announced = metadata.get("total_steps")
    if announced != steps:
        raise ValueError(f"{announced} steps are announced, {steps} are there")


def _check_memory(name: str, outlines: Sequence[PyTree], domain: Domain) -> None:
    """Checks, before anything is unpacked, that the demonstrations fit into memory.

    Raises:
        UserError: the demonstrations do not fit; says how much memory they need.
    """
    state = sum(leaf.nbytes for leaf in jax.tree.leaves(domain.blank))
    needed = sum((len(outline["actions"]) + 1) * (state + 8) for outline in outlines)
    read = [sum(leaf.nbytes for leaf in jax.tree.leaves(outline)) for outline in outlines]
    # An episode is in memory twice while it is checked.
    files.check_memory(needed + 2 * max(read, default=0), f"the Minari data set {name!r}")


def _name_episode(episode: int, name: str) -> str:
    return f"episode {episode} of the Minari data set {name!r}"
