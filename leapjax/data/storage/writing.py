"""Writes demonstrations as a Minari data set, atomically."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from minari.storage.datasets_root_dir import get_dataset_path

from leapjax import files
from leapjax.data.storage.datasets import find_datasets_folder, has_dataset
from leapjax.data.storage.spaces import make_observation_space, name_parts
from leapjax.domain import Collection, Domain
from leapjax.errors import UserError, first_line
from leapjax.types import Demonstration, PyTree

SCRATCH, LOCK = ".leapjax-unfinished-", ".leapjax-lock"  # hidden: Minari does not list them
BEFORE = "before"  # in the scratch folder: the data set that the new one replaces
ARRAY_ROOM = 2**12  # bytes that HDF5 needs for an array beside its elements


def save(name: str, collection: Collection, domain: Domain, description: str) -> None:
    """Writes demonstrations as a Minari data set.

    The write is atomic: a killed program leaves the whole data set, or the one before it.

    Args:
        name: id of the data set; replaces an existing data set with this id.
        collection: the demonstrations.
        domain: the level of the demonstrations.
        description: line for the metadata.

    Raises:
        UserError: the disk is full, the folder cannot be written to, or `name` is a folder of
            other data sets.
    """
    buffers = [
        EpisodeBuffer(
            id=index,
            seed=demonstration.seed,
            observations=_to_dictionaries(demonstration.observations),
            actions=list(demonstration.actions),
            rewards=demonstration.rewards.tolist(),
            terminations=_mark_last(demonstration, demonstration.terminated),
            truncations=_mark_last(demonstration, demonstration.truncated),
            infos={},
        )
        for index, demonstration in enumerate(collection.demonstrations)
    ]
    root = find_datasets_folder()
    try:
        with files.lock_folder(root / LOCK, wait=True):
            final = get_dataset_path(name)
            if final.exists() and not has_dataset(name):
                raise UserError(f"{name!r} is a folder of data sets: name another")
            files.check_room(root, _estimate_bytes(collection.demonstrations))
            for left_over in root.glob(f"{SCRATCH}*"):  # of killed programs
                _put_back(left_over / BEFORE, root)
                shutil.rmtree(left_over, ignore_errors=True)
            # Minari skips hidden folders, so it sees the data set only when it is complete.
            scratch = Path(tempfile.mkdtemp(prefix=SCRATCH, dir=root))
            whole = scratch / "whole"
            _write_folder(whole, buffers, domain, {"dataset_id": name, "description": description})
            final.parent.mkdir(parents=True, exist_ok=True)
            if final.exists():
                before = scratch / BEFORE / name
                before.parent.mkdir(parents=True)
                final.rename(before)
            whole.rename(final)
            files.flush(final.parent)
            shutil.rmtree(scratch, ignore_errors=True)
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001  (h5py and Minari raise many kinds)
        raise UserError(
            f"cannot write the data set {name!r} to {root} ({first_line(error)}): make room, or "
            "name another folder in MINARI_DATASETS_PATH"
        ) from None


def _estimate_bytes(demonstrations: Sequence[Demonstration]) -> int:
    """Estimates from above the bytes that uncompressed demonstrations take on the disk."""
    arrays = jax.tree.leaves([each[:5] for each in demonstrations])
    return sum(2 * np.asarray(each).nbytes + ARRAY_ROOM for each in arrays)


def _put_back(before: Path, root: Path) -> None:
    """Puts back the data set that a killed program had moved away to replace it."""
    for data in list(before.rglob("data")):
        name = data.parent.relative_to(before)
        if data.is_dir() and not (root / name).exists():
            data.parent.rename(root / name)


def _write_folder(
    folder: Path, buffers: list[EpisodeBuffer], domain: Domain, details: dict[str, str]
) -> None:
    """Writes a data set into a new folder."""
    folder.mkdir()
    storage = MinariStorage.new(
        folder / "data",
        observation_space=make_observation_space(domain.blank),
        action_space=gym.spaces.Discrete(domain.num_actions - 1),
        jpeg_encoding=False,  # grids are symbols, not pictures
    )
    storage.update_metadata(
        {
            "minari_version": minari.__version__,
            "algorithm_name": "a demonstrator",
            "author": {"leapjax"},
            **details,
        }
    )
    storage.update_episodes(buffers)
    for path in [*(folder / "data").iterdir(), folder / "data", folder]:
        files.flush(path)


def _to_dictionaries(observations: PyTree) -> Any:
    """Turns named tuples into dictionaries, which Minari can store."""
    if isinstance(observations, np.ndarray):
        return observations
    return {name: _to_dictionaries(part) for name, part in name_parts(observations).items()}


def _mark_last(demonstration: Demonstration, value: bool) -> list[bool]:
    """Makes a mark for each step: `value` for the last step, False for the others."""
    return [False] * (len(demonstration.actions) - 1) + [bool(value)]
