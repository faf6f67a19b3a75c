"""Seals checkpoints: hashes show whether numbers are intact and belong to a configuration."""

import hashlib
from pathlib import Path

import jax
import numpy as np

from leapjax.errors import UserError
from leapjax.serialization import IDENTITY, hash_identity
from leapjax.types import PyTree


def seal(parts: dict[str, PyTree], identity: str) -> dict[str, PyTree]:
    """Adds the SHA-256 of the arrays of each part, and the digest of an identity.

    Orbax's format detects damage to its structure, but not to the numbers.
    """
    return {
        **parts,
        "digests": {name: _hash_arrays(part) for name, part in parts.items()},
        IDENTITY: hash_identity(identity),
    }


def unseal(saved: dict[str, PyTree], identity: str, path: Path) -> dict[str, PyTree]:
    """Checks the hashes that `seal` added, and returns the parts without them.

    Raises:
        ValueError: the numbers are damaged.
        UserError: the numbers are intact, but belong to another identity.
    """
    parts = {name: part for name, part in saved.items() if name not in ("digests", IDENTITY)}
    for name, part in parts.items():
        if not np.array_equal(_hash_arrays(part), saved["digests"][name]):
            raise ValueError(f"the numbers of {name} are not those that were saved")
    check_same(saved[IDENTITY], identity, path)
    return parts


def check_same(saved: np.ndarray, identity: str, checkpoint: Path) -> None:
    """Checks that a saved digest `[32]` belongs to an identity.

    Raises:
        UserError: the checkpoint was saved with another identity.
    """
    if not np.array_equal(saved, hash_identity(identity)):
        raise UserError(
            f"the checkpoint {checkpoint} is of another configuration than the one beside it: it "
            "was copied here from another run, or the specification was changed; put back what "
            "was there, or train again in another folder",
            "runs",
        )


def _hash_arrays(tree: PyTree) -> np.ndarray:
    """Returns the SHA-256 of the arrays of a tree, `[32]` uint8."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
