"""Lets several processes work as one: the first process writes, and all agree on results.

With one process these functions do not communicate. With several (`jax.distributed`), all
processes call these functions, and run the programs on the shared devices, in the same order.
"""

import dataclasses
import json
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from leapjax.checks import check_at_least, check_types
from leapjax.errors import UserError
from leapjax.types import PyTree

T = TypeVar("T")
LAST_PORT = 2**16 - 1


@dataclasses.dataclass(frozen=True)
class Cluster:
    """The processes and devices that share a run.

    Attributes:
        coordinator: Address host:port of process 0, for several processes; SLURM and Open MPI set
            it themselves.
        num_processes: Number of processes, with a coordinator.
        process_id: Number of this process, from 0, with a coordinator.
        fsdp: Devices that share one copy of the parameters and the optimizer; 1 keeps a whole copy
            on each device.
    """

    coordinator: str | None = None
    num_processes: int | None = None
    process_id: int | None = None
    fsdp: int = 1

    def __post_init__(self) -> None:
        given = [self.coordinator, self.num_processes, self.process_id]
        check_types(self)
        check_at_least(self, 1, "fsdp")
        if given == [None, None, None]:
            return
        if self.coordinator is None or self.num_processes is None or self.process_id is None:
            raise ValueError("coordinator, num-processes and process-id are given together")
        if not 0 <= self.process_id < self.num_processes:
            raise ValueError(
                f"process-id is {self.process_id}, of {self.num_processes} processes: expected 0 "
                f"to {self.num_processes - 1}"
            )
        host, _, port = self.coordinator.rpartition(":")
        if not host or not port.isdecimal() or len(port) > 5 or int(port) > LAST_PORT:
            raise ValueError(
                f"coordinator is {self.coordinator!r}: expected host:port, a port of at most "
                f"{LAST_PORT}"
            )


def is_first() -> bool:
    """Returns whether this is the first process, which writes the files."""
    return jax.process_index() == 0


def gather(value: Any) -> list[Any]:
    """Collects a JSON value from every process, in the order of the processes."""
    if jax.process_count() == 1:
        return [value]
    data = np.frombuffer(json.dumps(value).encode(), np.uint8)
    sizes = multihost_utils.process_allgather(np.int32(data.size))
    # Padded to a power of two: JAX compiles a program for every length.
    padded = np.zeros(1 << (int(sizes.max()) - 1).bit_length(), np.uint8)
    padded[: data.size] = data
    rows = multihost_utils.process_allgather(padded)
    return [json.loads(row[:size].tobytes()) for row, size in zip(rows, sizes, strict=True)]


def run_together(work: Callable[[], T]) -> T:
    """Calls a function on every process; an error of one process stops all of them.

    Raises:
        UserError: a process raised it; if several did, the error of the first of them.
    """
    result, failure = None, None
    try:
        result = work()
    except UserError as error:
        failure = str(error)
    failures = [text for text in gather(failure) if text is not None]
    if failures:
        raise UserError(failures[0])
    return result  # type: ignore[return-value]


def run_on_first(work: Callable[[], Any]) -> Any:
    """Calls a function on the first process and returns its result, a JSON value, on all.

    Raises:
        UserError: the first process raised it.
    """
    return gather(run_together(lambda: work() if is_first() else None))[0]


def broadcast(tree: PyTree) -> PyTree:
    """Returns the first process's NumPy arrays on all; the others pass arrays of equal shapes."""
    return multihost_utils.broadcast_one_to_all(tree)
