"""Demonstrations as Minari data sets: written once, atomically, and read by one path.

A data set of the user's own, of the same observations, is read in the same way.
"""

import json
import math
import os
import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.storage.datasets_root_dir import get_dataset_path

from leapjax.data.demonstrations import Collection, Demonstration
from leapjax.envs import vocabulary
from leapjax.envs.adapter import NUM_ACTIONS
from leapjax.envs.levels import Level
from leapjax.errors import UserError, first_line
from leapjax.types import Observation

LARGEST_SPACE = 10_000_000  # elements
UNKNOWN_SEED = -1  # of a user's episodes: no test level has it
FORMAT = 1  # raised whenever what a demonstration holds changes: old caches are then unused


def dataset_id(level: Level, count: int, seed: int) -> str:
    """The id under which `count` demonstrations for a training seed are cached."""
    return f"leapjax/{level.name}/bot-{count}-seed{seed}-v{FORMAT}"


def observation_space(side: int, words: int) -> gym.spaces.Dict:
    """The Minari observation space of an `Observation`."""

    def integers(length: int) -> gym.spaces.Box:
        return gym.spaces.Box(-1, 255, (length,), np.int32)

    return gym.spaces.Dict(
        {
            "grid": gym.spaces.Box(0, 255, (side, side, 3), np.uint8),
            "pose": integers(3),
            "carried": integers(2),
            "goal": integers(2),
            "instruction": integers(words),
        }
    )


def save(name: str, collection: Collection, description: str) -> None:
    """Writes a Minari data set; a killed program leaves either all of it or nothing."""
    demonstrations = collection.demonstrations
    first = demonstrations[0].observations
    buffers = [
        EpisodeBuffer(
            id=index,
            seed=demonstration.seed,
            observations=demonstration.observations._asdict(),
            actions=list(demonstration.actions),
            rewards=[0.0] * (len(demonstration.actions) - 1) + [1.0],
            terminations=[False] * (len(demonstration.actions) - 1) + [True],
            truncations=[False] * len(demonstration.actions),
            infos={},
        )
        for index, demonstration in enumerate(demonstrations)
    ]
    final = get_dataset_path(name)
    final.parent.mkdir(parents=True, exist_ok=True)
    # Minari writes in place, under an id: write under a temporary id, then rename.
    scratch = f"leapjax/unfinished-{os.getpid()}-v0"
    shutil.rmtree(get_dataset_path(scratch), ignore_errors=True)
    with warnings.catch_warnings():
        # Minari would have an author's e-mail and an environment that Gymnasium can make.
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            dataset_id=scratch,
            buffer=buffers,
            action_space=gym.spaces.Discrete(NUM_ACTIONS - 1),
            observation_space=observation_space(first.grid.shape[1], first.instruction.shape[1]),
            algorithm_name="BabyAI bot",
            author="leapjax",
            code_permalink="https://github.com/Farama-Foundation/Minigrid",
            description=description,
            jpeg_encoding=False,  # grids are symbols, not pictures
        )
    path = get_dataset_path(scratch)
    _rename_id(path, scratch, name)
    if final.exists():
        shutil.rmtree(final)
    path.rename(final)


def load(name: str, level: Level, side: int) -> list[Demonstration]:
    """The demonstrations of a Minari data set, checked against a level.

    Raises:
        UserError: missing, damaged, empty, or not of this level's observations.
    """
    if not get_dataset_path(name).exists():
        raise UserError(
            f"no Minari data set {name!r} in {get_dataset_path()}: "
            "check the id with `minari list local`"
        )
    try:
        _inspect(get_dataset_path(name) / "data")
        dataset = minari.load_dataset(name)
        episodes = list(dataset.iterate_episodes())
        metadata = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
    except Exception as error:  # noqa: BLE001  (h5py and Minari raise many kinds)
        raise UserError(
            f"the Minari data set {name!r} cannot be read ({first_line(error)}): "
            "delete it and it is made again, or restore it"
        ) from None
    if not episodes:
        raise UserError(f"the Minari data set {name!r} has no episodes")
    demonstrations = []
    for episode, details in zip(episodes, metadata, strict=True):
        where = f"episode {episode.id} of the Minari data set {name!r}"
        states = _observation(episode.observations, where)
        actions = _integers(episode.actions, f"{where}: actions")
        _check_episode(states, actions, where, level, side)
        states = Observation(*(field.astype(np.int32) for field in states))
        states = states._replace(grid=states.grid.astype(np.uint8))
        seed = int(details.get("seed", UNKNOWN_SEED))
        demonstrations.append(Demonstration(states, actions.astype(np.int32), seed))
    return demonstrations


def _inspect(folder: Path) -> None:
    """Refuses what must not even be opened by Minari and HDF5.

    Without its spaces Minari makes the environment that the data names, which runs code of
    the data's choice. Sizes that are only claimed, and files elsewhere that are linked to,
    would be read.

    Raises:
        ValueError: says what.
    """
    metadata = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    if not isinstance(metadata, dict):
        raise ValueError("metadata.json is not a JSON object")
    if metadata.get("data_format") != "hdf5":
        raise ValueError(f"its format is {metadata.get('data_format')!r}, expected 'hdf5'")
    for name in ("observation_space", "action_space"):
        if not isinstance(metadata.get(name), str):
            raise ValueError(f"metadata.json has no {name}")
        _check_sizes(json.loads(metadata[name]))
    with h5py.File(folder / "main_data.hdf5") as file:
        total = metadata.get("total_episodes")
        if not isinstance(total, int) or not 0 <= total <= len(file):
            raise ValueError(f"{total} episodes are announced, {len(file)} are there")
        _check_group(file)


def _check_sizes(space: Any) -> None:
    """No space may ask for more than a picture's worth of bounds."""
    if isinstance(space, dict):
        for key in ("shape", "n"):
            numbers = space.get(key)
            sizes = numbers if isinstance(numbers, list) else [numbers]
            sizes = [size for size in sizes if isinstance(size, int)]
            if space.get("type") != "Discrete" and math.prod(sizes) > LARGEST_SPACE:
                raise ValueError(f"a space of shape {numbers}")
        space = list(space.values())
    if isinstance(space, list):
        for part in space:
            _check_sizes(part)


def _check_group(group: h5py.Group) -> None:
    for name in group:
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{name} is a link to somewhere else")
        item = group[name]
        if isinstance(item, h5py.Group):
            _check_group(item)
            continue
        if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual:
            raise ValueError(f"{name} is not an array of this file")
        # gzip makes at most 1 byte of 1032.
        if item.nbytes > 1032 * item.id.get_storage_size() + 1024:
            raise ValueError(f"{name} claims {item.nbytes} bytes, which are not there")


def _observation(fields: object, where: str) -> Observation:
    missing = [f for f in Observation._fields if not isinstance(fields, dict) or f not in fields]
    if missing:
        raise UserError(
            f"{where} has no observation {missing[0]!r}: "
            f"expected a dictionary of {', '.join(Observation._fields)}"
        )
    assert isinstance(fields, dict)
    return Observation(**{f: _integers(fields[f], f"{where}: {f}") for f in Observation._fields})


def _integers(values: object, what: str) -> np.ndarray:
    array = np.asarray(values)
    if not np.issubdtype(array.dtype, np.integer):
        raise UserError(f"{what} must be integers, got {array.dtype}")
    return array.astype(np.int64)  # wide enough for what the range check must still see


def _check_episode(
    states: Observation, actions: np.ndarray, where: str, level: Level, side: int
) -> None:
    if actions.ndim != 1:
        raise UserError(f"{where}: actions have shape {actions.shape}, expected one per step")
    steps = len(actions)
    expected = {
        "grid": (steps + 1, side, side, 3),
        "pose": (steps + 1, 3),
        "carried": (steps + 1, 2),
        "goal": (steps + 1, 2),
        "instruction": (steps + 1, level.words),
    }
    if steps == 0:
        raise UserError(f"{where} has no actions")
    for field, shape in expected.items():
        actual = getattr(states, field).shape
        if actual != shape:
            raise UserError(
                f"{where}: {field} has shape {actual}, level {level.name} needs {shape}"
            )
    ranges = {
        "grid objects": (states.grid[..., 0], 0, 10),
        "grid colours": (states.grid[..., 1], 0, 5),
        "grid states": (states.grid[..., 2], 0, 3),
        "positions": (states.pose[:, :2], 0, side - 1),
        "directions": (states.pose[:, 2], 0, 3),
        "goals": (states.goal, -1, side - 1),
        "instruction": (states.instruction, 0, vocabulary.SIZE - 1),
        "carried objects": (states.carried[:, 0], 0, 10),
        "carried colours": (states.carried[:, 1], 0, 5),
        "actions": (actions, 0, NUM_ACTIONS - 2),
    }
    for field, (values, low, high) in ranges.items():
        if values.min() < low or values.max() > high:
            raise UserError(
                f"{where}: {field} run from {values.min()} to {values.max()}, "
                f"expected {low} to {high}"
            )


def _rename_id(path: Path, old: str, new: str) -> None:
    """Minari keeps the id inside the data set too."""
    metadata = path / "data" / "metadata.json"
    metadata.write_text(metadata.read_text().replace(old, new))


def exists(name: str) -> bool:
    """Whether a data set of that id is in the local Minari folder."""
    return get_dataset_path(name).exists()
