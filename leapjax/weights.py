"""Parameters in one small file, in half precision: what a planner is published as."""

import hashlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from leapjax import files
from leapjax.errors import UserError, first_line
from leapjax.types import Params

IDENTITY = "identity"  # the entry that says whose parameters they are


def write(path: Path, params: Params, identity: str) -> None:
    """Writes parameters as float16, atomically.

    Args:
        path: of a NumPy archive, `.npz`.
        params: of float32.
        identity: without it they cannot be read again.

    Raises:
        ValueError: a parameter that is too large for half precision.
    """
    with np.errstate(over="ignore"):  # said below
        arrays = {name: np.asarray(leaf, np.float16) for name, leaf in _by_name(params)}
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} does not fit half precision")
    with files.whole(path) as scratch, scratch.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays, **{IDENTITY: _digest(identity)})


def read(path: Path, like: Params, identity: str) -> Params:
    """Parameters of float32.

    Args:
        path: of a file that `write` has made.
        like: gives structure and shapes.
        identity: that they were written with.

    Raises:
        UserError: the file cannot be read, or is of another configuration.
    """
    wanted = dict(_by_name(like))
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
    except Exception as error:  # noqa: BLE001  (zipfile, zlib and NumPy raise many kinds)
        raise UserError(f"cannot read {path}: {first_line(error)}") from None
    whose = found.pop(IDENTITY, None)
    fits = found.keys() == wanted.keys() and all(
        found[name].shape == leaf.shape and found[name].dtype == np.float16
        for name, leaf in wanted.items()
    )
    if not fits or not np.array_equal(whose, _digest(identity)):
        raise UserError(f"{path} is of another configuration than the one beside it")
    leaves = [jnp.asarray(found[name], jnp.float32) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _by_name(params: Params) -> list[tuple[str, jax.Array]]:
    """The leaves in the order of the tree, by their path in it."""
    leaves = jax.tree.leaves_with_path(params)
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in leaves]


def _digest(identity: str) -> np.ndarray:
    return np.frombuffer(hashlib.sha256(identity.encode()).digest(), np.uint8)
