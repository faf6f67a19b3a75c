"""Unpacks the arrays of a shard block by block."""

import contextlib
import gzip
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from leapjax.domains.atari.replay.shards import STORED, part_path
from leapjax.errors import UserError, first_line

_BLOCK = 2**19  # bytes to unpack at once
_EXPANSION = 1032  # largest compression ratio of gzip


class Array(NamedTuple):
    """An array that is unpacked from its first row to its last.

    Attributes:
        path: path of the file.
        file: the file, open at the next row.
        dtype: type of the elements.
        shape: shape of a row.
        rows: number of rows.
    """

    path: Path
    file: gzip.GzipFile
    dtype: np.dtype
    shape: tuple[int, ...]
    rows: int


@contextlib.contextmanager
def open_array(logs: Path, number: int, name: str) -> Iterator[Array]:
    """Opens a part of a shard, and reads only its header.

    Raises:
        UserError: the file is damaged, or not of DQN-Replay.
    """
    path = part_path(logs, f"$store$_{name}", number)
    dtype, row = STORED[name]
    with contextlib.ExitStack() as stack:
        with _explain_damage(path):
            file = stack.enter_context(gzip.open(path))
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError("not of version 1.0")
            shape, fortran, found = np.lib.format.read_array_header_1_0(file)
        if found != dtype or len(shape) == 0 or shape[1:] != row or fortran:
            expected = ", ".join(map(str, ("R", *row)))
            raise UserError(
                f"{path} holds {found} of shape {shape}, expected {dtype} of shape [{expected}]: "
                "it is not of DQN-Replay"
            )
        claimed, room = dtype.itemsize * math.prod(shape), _EXPANSION * path.stat().st_size
        if claimed > room:
            raise UserError(
                f"{path} claims to hold {claimed} bytes, and has room for {room}: copy it again or "
                "delete all parts of its shard"
            )
        yield Array(path, file, dtype, row, shape[0])


def read_blocks(array: Array, rows: int) -> Iterator[np.ndarray]:
    """Yields the next rows of an array in blocks, `[n, ...]`."""
    size = array.dtype.itemsize * math.prod(array.shape)
    while rows > 0:
        count = min(rows, max(1, _BLOCK // size))
        with _explain_damage(array.path):
            data = array.file.read(count * size)
            if len(data) < count * size:
                raise EOFError("it ends before its last row")
        yield np.frombuffer(data, array.dtype).reshape(count, *array.shape)
        rows -= count


def read_rows(array: Array, rows: int) -> np.ndarray:
    """Reads the next rows of an array, `[rows, ...]`."""
    return np.concatenate([np.empty((0, *array.shape), array.dtype), *read_blocks(array, rows)])


@contextlib.contextmanager
def _explain_damage(path: Path) -> Iterator[None]:
    """Turns exceptions of gzip and NumPy into a `UserError` that the file is damaged."""
    try:
        yield
    except Exception as error:  # noqa: BLE001  (gzip, zlib and NumPy raise many kinds)
        raise UserError(
            f"cannot read {path} ({first_line(error)}): expected a gzip of a NumPy array, copy it "
            "again or delete all parts of its shard"
        ) from None
