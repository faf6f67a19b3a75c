"""What a run needs of memory, judged before it begins: a machine without any left kills it."""

import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from leapjax.errors import UserError
from leapjax.types import PyTree, TrainState


def installed() -> int | None:
    """Bytes of memory that this machine has; None where it does not say, as on Windows."""
    if not hasattr(os, "sysconf"):
        return None
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def check(needs: Mapping[str, int]) -> None:
    """Refuses what needs more memory than the machine has.

    Args:
        needs: bytes, by the options that ask for them.

    Raises:
        UserError: names the options.
    """
    memory = installed()
    for options, needed in needs.items():
        if memory is not None and needed > memory:
            raise UserError(
                f"{options}: at least {needed >> 30} GiB of memory would be needed, and this "
                f"machine has {memory >> 30}"
            )


def check_state(state: TrainState) -> None:
    """Refuses a network that is too large to be trained here.

    Args:
        state: shapes of all that training changes. Gradients are as large as the parameters.

    Raises:
        UserError: says how large it is.
    """
    sizes = "--width, --layers, and sizes of the method and the domain"
    check({sizes: _bytes(state) + _bytes(state.params)})


def check_program(program: Any) -> None:
    """Refuses a step of training whose program, as it was compiled, does not fit.

    Args:
        program: compiled for the devices of this machine.

    Raises:
        UserError: says how much it needs.
    """
    found = program.memory_analysis()
    if found is None or jax.default_backend() != "cpu":  # GPUs have memory of their own
        return
    device = found.temp_size_in_bytes + found.argument_size_in_bytes
    options = "--batch (or a smaller --microbatch), --context and the sizes of the network"
    check({options: device * jax.local_device_count()})


def _bytes(tree: PyTree) -> int:
    leaves = jax.tree.leaves(tree)
    return sum(int(np.prod(leaf.shape, dtype=object)) * leaf.dtype.itemsize for leaf in leaves)
