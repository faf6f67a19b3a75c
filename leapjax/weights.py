"""Parameters in one small file, in half precision: what a planner is published as."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from leapjax import checkpoints, files
from leapjax.checkpoints import IDENTITY, identity_digest
from leapjax.errors import UserError, first_line
from leapjax.types import Params


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
        np.savez_compressed(
            file, allow_pickle=False, **arrays, **{IDENTITY: identity_digest(identity)}
        )


def check_identity(path: Path, identity: str) -> checkpoints.Shapes:
    """Checks with which identity parameters were written, and unpacks none of them.

    Args:
        path: of a file that `write` has made.
        identity: that they should be of.

    Returns:
        The shapes of the parameters, by their place in the tree.

    Raises:
        UserError: the file cannot be read, or is of another configuration.
    """
    try:
        headers = files.read_headers(path)
        whose = np.array([])
        if headers.pop(IDENTITY, None) == (identity_digest("").shape, np.uint8):
            with np.load(path, allow_pickle=False) as archive:
                whose = archive[IDENTITY]
    except Exception as error:  # noqa: BLE001  (zipfile, zlib and NumPy raise many kinds)
        raise UserError(f"cannot read {path}: {first_line(error)}") from None
    if not np.array_equal(whose, identity_digest(identity)) or any(
        dtype != np.float16 for _, dtype in headers.values()
    ):
        raise UserError(f"{path} is of another configuration than the one beside it")
    return {name: shape for name, (shape, _) in headers.items()}


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
    found = check_identity(path, identity)
    if found != {name: leaf.shape for name, leaf in wanted.items()}:
        raise UserError(f"{path} is of another configuration than the one beside it")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in wanted}
    except Exception as error:  # noqa: BLE001  (zipfile, zlib and NumPy raise many kinds)
        raise UserError(f"cannot read {path}: {first_line(error)}") from None
    leaves = [jnp.asarray(array, jnp.float32) for array in arrays.values()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _by_name(params: Params) -> list[tuple[str, jax.Array]]:
    """The leaves in the order of the tree, by their path in it."""
    leaves = jax.tree.leaves_with_path(params)
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in leaves]
