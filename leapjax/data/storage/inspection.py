"""Inspects a data set of unknown origin before Minari opens it and unpacks its arrays."""

import io
import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from minari.dataset.minari_storage import is_image_space
from minari.serialization import deserialize_space
from PIL import Image

from leapjax import files
from leapjax.data.storage.spaces import SPACES
from leapjax.errors import UserError
from leapjax.types import PyTree

LARGEST_SPACE = 10_000_000  # elements
LARGEST_CHUNK = 2**24  # bytes; h5py chooses chunks of at most a sixteenth of this
DEEPEST = 16  # levels of nested groups
SLAB = 2**28  # bytes to read at once while sizes are unknown


def read_metadata(folder: Path) -> dict[str, Any]:
    """Reads the metadata of a data set.

    Raises:
        ValueError: the metadata cannot be read.
    """
    try:
        text = files.read_text(folder / "metadata.json")
    except UserError as error:  # the caller adds the remedy
        raise ValueError(str(error)) from None
    metadata = json.loads(text)
    if not isinstance(metadata, dict):
        raise ValueError("metadata.json is not a JSON object")
    return metadata


def inspect_dataset(folder: Path, metadata: dict[str, Any]) -> list[PyTree]:
    """Checks that Minari and HDF5 can open a data set safely; reads no array.

    If the spaces are missing, Minari makes the environment that the data name, which runs code
    that the data choose. HDF5 would allocate any size that a file claims, and follow links to
    other files.

    Returns:
        An outline of each episode: see `_outline_file`.

    Raises:
        ValueError: the data set is not safe to open; says why.
    """
    if metadata.get("data_format") != "hdf5":
        raise ValueError(f"its format is {metadata.get('data_format')!r}, expected 'hdf5'")
    for name in SPACES:
        if not isinstance(metadata.get(name), str):
            raise ValueError(f"metadata.json has no {name}")
        _check_sizes(json.loads(metadata[name]))
    spaces = [deserialize_space(metadata[name]) for name in SPACES]
    path = folder / "main_data.hdf5"
    with h5py.File(path) as file:
        total = metadata.get("total_episodes")
        if not isinstance(total, int) or total != len(file):
            raise ValueError(f"{total} episodes are announced, {len(file)} are there")
        outlines = _outline_file(file, path.stat().st_size)
        names = [f"episode_{index}" for index in range(total)]
        missing = [name for name in names if not isinstance(outlines.get(name), dict)]
        if missing:
            raise ValueError(f"{missing[0]} is not there")
        episodes = [outlines[name] for name in names]
        for index, outline in enumerate(episodes) if may_have_jpeg(metadata) else ():
            for part, space in zip(("observations", "actions"), spaces, strict=True):
                if part in outline:
                    stored = file[names[index]][part]
                    outline[part] = _outline_frames(outline[part], stored, space)
    return episodes


def may_have_jpeg(metadata: dict[str, Any]) -> bool:
    """Returns whether a data set stores the parts that Minari calls pictures as JPEG."""
    return bool(metadata.get("jpeg_encoding", True))  # as Minari reads it


def has_jpeg_observations(metadata: dict[str, Any]) -> bool:
    """Returns whether a part of the observations is stored as JPEG, which changes its numbers."""
    return may_have_jpeg(metadata) and _has_image(deserialize_space(metadata[SPACES[0]]))


def _has_image(space: gym.Space) -> bool:
    if isinstance(space, gym.spaces.Dict):
        return any(map(_has_image, space.spaces.values()))
    return is_image_space(space)


def _check_sizes(space: Any) -> None:
    """Checks that the bounds of each space have at most `LARGEST_SPACE` elements.

    Raises:
        ValueError: names the shape of a larger space.
    """
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


def _outline_file(file: h5py.File, file_size: int) -> dict[str, Any]:
    """Lists the arrays of a file without reading them.

    The objects must form a tree, as in files that Minari writes. If an object has two names, a walk
    through all names may never end.

    Returns:
        A dictionary by name. A group becomes such a dictionary. An array becomes an array of the
        same shape and type that takes no memory.

    Raises:
        ValueError: the file has links, an object with two names, groups nested too deep, or arrays
            whose bytes are not in the file.
    """
    outline: dict[str, Any] = {}
    known = {_find_identity(file)}
    groups: list[tuple[h5py.Group, dict[str, Any], int]] = [(file, outline, 0)]
    while groups:
        group, found, depth = groups.pop()
        if depth > DEEPEST:
            raise ValueError(f"{group.name[:60]} is a group in {depth} groups")
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{name} is a link to somewhere else")
            item = group[name]
            identity = _find_identity(item)
            if identity in known:
                raise ValueError(f"{name} is an object that has another name too")
            known.add(identity)
            if isinstance(item, h5py.Group):
                found[name] = {}
                groups.append((item, found[name], depth + 1))
                continue
            if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual:
                raise ValueError(f"{name} is not an array of this file")
            array = found[name] = np.broadcast_to(np.zeros((), item.dtype), item.shape)
            # gzip compresses at most 1032 bytes to 1.
            if array.nbytes > 1032 * item.id.get_storage_size() + 1024:
                raise ValueError(f"{name} claims {array.nbytes} bytes, which are not there")
            # HDF5 unpacks whole chunks, which may be larger than their array.
            chunk = math.prod(item.chunks or ()) * array.itemsize
            if chunk > max(array.nbytes, LARGEST_CHUNK):
                raise ValueError(f"{name} is stored in pieces of {chunk} bytes")
            if array.dtype.hasobject:
                _check_varying(item, name, file_size)
    return outline


def _find_identity(item: Any) -> tuple[int, int]:
    """Returns a key of an HDF5 object that does not depend on its name."""
    info = h5py.h5o.get_info(item.id)
    return info.fileno, info.addr


def _check_varying(array: h5py.Dataset, name: str, file_size: int) -> None:
    """Checks that elements of varying length are together no longer than their file.

    Raises:
        ValueError: says how long they are.
    """
    total, at_once = 0, max(16, SLAB // file_size)
    for start in range(0, array.shape[0] if array.shape else 0, at_once):
        total += sum(len(each) for each in np.ravel(array[start : start + at_once]))
        if total > file_size:
            raise ValueError(f"{name} claims {total} bytes, which are not there")


def _outline_frames(outline: Any, stored: Any, space: gym.Space) -> Any:
    """Replaces the stored JPEG frames of an outline by the arrays that Minari unpacks from them.

    Raises:
        ValueError: a frame has another size than its space.
    """
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple) and isinstance(outline, dict):
        parts = (
            dict(space.spaces)
            if isinstance(space, gym.spaces.Dict)
            else {f"_index_{index}": part for index, part in enumerate(space.spaces)}
        )
        return {
            name: _outline_frames(part, stored[name], parts[name]) if name in parts else part
            for name, part in outline.items()
        }
    if not is_image_space(space) or isinstance(outline, dict):
        return outline
    assert space.shape is not None  # an image space has a shape
    largest = 2 * math.prod(space.shape) + 4096  # bytes of a stored frame
    for start in range(0, len(stored), at_once := max(1, SLAB // largest)):
        for frame in stored[start : start + at_once]:
            with Image.open(io.BytesIO(frame)) as image:  # reads only the header
                shape = (image.height, image.width, len(image.getbands()))
            if shape[: len(space.shape)] != space.shape or len(frame) > largest:
                raise ValueError(
                    f"a frame of shape {shape} in {len(frame)} bytes, its space is {space.shape}"
                )
    return np.broadcast_to(np.zeros((), np.uint8), (len(stored), *space.shape))
