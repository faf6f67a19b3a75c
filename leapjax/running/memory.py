"""Checks before a run that memory suffices: the system kills a process that exceeds it."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from leapjax.files import check_memory
from leapjax.types import PyTree, TrainState


def check(needs: Mapping[str, int]) -> None:
    """Checks that the machine has enough memory.

    Args:
        needs: number of bytes, by the options that need them.

    Raises:
        UserError: the memory is too small; names the options.
    """
    for options, needed in needs.items():
        check_memory(needed, options)


def check_state(state: TrainState) -> None:
    """Checks that the network can be trained in this machine's memory.

    Args:
        state: shapes of the training state. Gradients are as large as the parameters.

    Raises:
        UserError: the state is too large; says its size.
    """
    sizes = "--width, --layers, and sizes of the method and the domain"
    check({sizes: _count_bytes(state) + _count_bytes(state.params)})


def check_program(program: Any) -> None:
    """Checks that a compiled step of training fits into memory.

    Args:
        program: program compiled for the devices of this machine.

    Raises:
        UserError: the step needs too much memory; says how much.
    """
    found = program.memory_analysis()
    if found is None or jax.default_backend() != "cpu":  # GPUs have memory of their own
        return
    device = found.temp_size_in_bytes + found.argument_size_in_bytes
    options = "--batch (or a smaller --microbatch), --context and the sizes of the network"
    check({options: device * jax.local_device_count()})


def _count_bytes(tree: PyTree) -> int:
    leaves = jax.tree.leaves(tree)
    return sum(int(np.prod(leaf.shape, dtype=object)) * leaf.dtype.itemsize for leaf in leaves)
