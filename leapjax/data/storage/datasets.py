"""Minari data sets on this machine: their ids, their folder and their metadata."""

import json
import os
import re
from pathlib import Path

from minari.storage.datasets_root_dir import get_dataset_path

from leapjax import files
from leapjax.domain import Described, Domain
from leapjax.errors import UserError, first_line

FORMAT = 2  # raise it whenever the content of a demonstration changes: old caches are then unused
UNKNOWN_SEED = -1  # stands for the seed of an episode if unknown: no test level has this seed


def name_dataset(domain: Domain, count: int, seed: int) -> str:
    """Returns the id under which `count` demonstrations for a training seed are cached."""
    return f"leapjax/{domain.level}/bot-{count}-seed{seed}-v{FORMAT}"


def find_version(name: str) -> int | None:
    """Returns the format in the id of a data set that this library made; `None` for other ids."""
    found = re.fullmatch(r"leapjax/.*/bot-.*-v(\d+)", name)
    return int(found[1]) if found else None


def find_datasets_folder() -> Path:
    """Returns Minari's folder of data sets; makes it if it does not exist.

    Raises:
        UserError: the folder cannot be made, or its path is a file.
    """
    chosen = os.environ.get("MINARI_DATASETS_PATH")
    if chosen == "":
        raise UserError("MINARI_DATASETS_PATH is empty: name a folder in it, or unset it")
    try:
        return get_dataset_path().absolute()
    except OSError as error:
        raise UserError(
            f"no folder for data sets at {chosen or Path.home()} ({first_line(error)}): name "
            "another in MINARI_DATASETS_PATH"
        ) from None


def check_writable() -> None:
    """Checks that Minari's folder of data sets can be written to.

    Raises:
        UserError: the folder cannot be written to; names it.
    """
    root = find_datasets_folder()
    if not os.access(root, os.W_OK):
        raise UserError(f"cannot write to {root}: name another folder in MINARI_DATASETS_PATH")


def has_dataset(name: str) -> bool:
    """Returns whether the local Minari folder has a data set with this id."""
    # A folder without `data` is a namespace, which may hold data sets.
    try:
        return (find_datasets_folder() / name / "data").exists()
    except OSError:  # an impossible file name, or an unreadable folder
        return False


def describe_dataset(name: str) -> Described:
    """Reads the environment of a data set from its metadata; unknown fields are `None`."""
    path = find_datasets_folder() / name / "data" / "metadata.json"
    try:
        metadata = json.loads(files.read_text(path))
        count = metadata.get("total_episodes")
    except (OSError, ValueError, AttributeError, RecursionError):
        return Described()
    known = Described(episodes=count if isinstance(count, int) and count > 0 else None)
    try:
        spec = json.loads(metadata["env_spec"])
        level, arguments, most = spec["id"], spec.get("kwargs"), spec.get("max_episode_steps")
        wrappers = spec.get("additional_wrappers")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return known
    listed = isinstance(wrappers, list) and all(isinstance(each, dict) for each in wrappers)
    return known._replace(
        level=level if isinstance(level, str) else None,
        arguments=arguments if isinstance(arguments, dict) else None,
        wrappers=wrappers if listed else None,
        max_steps=most if isinstance(most, int) else None,
    )
