"""Reads the paths and shapes of the arrays in a checkpoint, without their numbers."""

import json
from pathlib import Path

import jax
import numpy as np
import tensorstore

from leapjax.errors import UserError
from leapjax.serialization import IDENTITY, hash_identity
from leapjax.types import PyTree

ITEM = "default"  # Orbax's name for the only item of a checkpoint
Shapes = dict[str, tuple[int, ...]]  # by the path of an array in its tree, such as params/w


def read_shapes(checkpoint: Path) -> Shapes:
    """Reads the shapes of the arrays in a checkpoint, without the arrays.

    Orbax's `metadata` reads them too, but leaks a megabyte at every call.

    Raises:
        ValueError: there are no arrays, or an array has chunks larger than itself.
    """
    store = _open_store(checkpoint)
    shapes = {}
    for key in store.list().result():
        name = key.decode()
        if name.endswith("/.zarray"):
            description = json.loads(store.read(key).result().value)
            place = name.removesuffix("/.zarray").replace(".", "/")
            shapes[place] = tuple(description["shape"])
            pieces = zip(description["chunks"], shapes[place], strict=True)
            if any(piece > max(1, size) for piece, size in pieces):
                raise ValueError(f"{place} is in pieces that are larger than it is")
    if not shapes:
        raise ValueError("it has no arrays")
    return shapes


def read_identity(checkpoint: Path) -> np.ndarray:
    """Reads the digest of the identity that a checkpoint was saved with: `[32]` uint8."""
    kvstore = _open_store(checkpoint).spec().to_json()
    array = tensorstore.open(
        {"driver": "zarr", "kvstore": {**kvstore, "path": f"{IDENTITY}/"}},
        dtype=tensorstore.uint8, shape=hash_identity("").shape, open=True,
    )  # fmt: skip
    return array.result().read().result()


def _open_store(checkpoint: Path) -> tensorstore.KvStore:
    """Opens the keys and values of a checkpoint."""
    base = {"driver": "file", "path": f"{checkpoint / ITEM}/"}
    return tensorstore.KvStore.open({"driver": "ocdbt", "base": base}).result()


def check_shapes(found: Shapes, like: PyTree, checkpoint: Path) -> None:
    """Checks that the arrays of a checkpoint have the paths and shapes of the arrays in `like`.

    Raises:
        UserError: names the first array that differs.
    """
    expected = _list_shapes(like)
    for name in sorted(expected.keys() | found.keys()):
        if found.get(name) != expected.get(name):
            raise UserError(
                f"the checkpoint {checkpoint} does not fit its configuration: {name} is "
                f"{found.get(name, 'missing')}, expected {expected.get(name, 'nothing')}; it was "
                "made by another version: remove it, or use another folder",
                "runs",
            )


def _list_shapes(tree: PyTree) -> Shapes:
    """Returns the shapes of the arrays of a tree, by path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    # Orbax stores named tuples and lists as dictionaries: compare only the names.
    return {
        "/".join(
            str(getattr(k, "key", getattr(k, "idx", getattr(k, "name", k)))) for k in path
        ): tuple(leaf.shape)
        for path, leaf in leaves
    }


def make_blank(like: PyTree) -> PyTree:
    """Makes NumPy arrays of zeros with the shapes and types to read."""
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), like)
