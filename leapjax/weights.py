"""Writes and reads the parameters of published planners: one small file, in half precision."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from leapjax import files
from leapjax.errors import UserError, first_line
from leapjax.serialization import IDENTITY, hash_identity
from leapjax.types import Params

ITEMSIZE = 2  # bytes of a number in half precision
HEADER = 1024  # bytes of an array in the archive beside its numbers, at most


def write(path: Path, params: Params, identity: str) -> None:
    """Writes parameters as float16, atomically.

    Args:
        path: path of a NumPy archive, `.npz`.
        params: parameters in float32.
        identity: identity of their configuration; `read` needs the same identity.

    Raises:
        ValueError: a parameter is too large for half precision.
    """
    with np.errstate(over="ignore"):  # reported below
        arrays = {name: np.asarray(leaf, np.float16) for name, leaf in _name_parameters(params)}
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} does not fit half precision")
    with files.write_whole(path) as scratch, scratch.open("wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, **arrays, **{IDENTITY: hash_identity(identity)}
        )


def check_identity(path: Path, identity: str) -> list[int]:
    """Checks the identity that parameters were written with, without unpacking them.

    Args:
        path: path of a file that `write` has made.
        identity: expected identity.

    Returns:
        Number of elements of each array, at most.

    Raises:
        UserError: the file cannot be read, or belongs to another configuration.
    """
    with _explain_failure(path):
        sizes = files.read_sizes(path)
        if sizes.pop(IDENTITY, 2**20) > HEADER:
            raise _make_mismatch_error(path)
        with np.load(path, allow_pickle=False) as archive:
            if not np.array_equal(archive[IDENTITY], hash_identity(identity)):
                raise _make_mismatch_error(path)
    return [size // ITEMSIZE for size in sizes.values()]


def read(path: Path, like: Params, identity: str) -> Params:
    """Reads parameters and converts them to float32.

    Args:
        path: path of a file that `write` has made.
        like: parameters of the same structure and shapes.
        identity: identity that the parameters were written with.

    Raises:
        UserError: the file cannot be read, or belongs to another configuration.
    """
    check_identity(path, identity)
    wanted = dict(_name_parameters(like))
    with _explain_failure(path):
        sizes = files.read_sizes(path)
        if sizes.keys() != wanted.keys() | {IDENTITY} or any(
            not 0 <= sizes[name] - ITEMSIZE * leaf.size <= HEADER for name, leaf in wanted.items()
        ):
            raise _make_mismatch_error(path)
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in wanted}
    for name, leaf in wanted.items():
        if (arrays[name].shape, arrays[name].dtype) != (leaf.shape, np.float16):
            raise _make_mismatch_error(path)
    # NumPy converts: JAX would compile a program for each shape.
    leaves = [jnp.asarray(array.astype(np.float32)) for array in arrays.values()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


@contextlib.contextmanager
def _explain_failure(path: Path) -> Iterator[None]:
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001  (zipfile, zlib and NumPy raise many kinds)
        raise UserError(f"cannot read {path}: {first_line(error)}") from None


def _make_mismatch_error(path: Path) -> UserError:
    return UserError(f"{path} is of another configuration than the one beside it")


def _name_parameters(params: Params) -> list[tuple[str, jax.Array]]:
    """Returns the (path in the tree, parameter) pairs, in the order of the tree."""
    leaves = jax.tree.leaves_with_path(params)
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in leaves]
