"""Several processes that work as one: who writes, and what all of them agree on.

With one process nothing here costs anything. With more (`jax.distributed`), all of them
call these functions, and everything that runs on the shared devices, in the same order.
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
        coordinator: Address host:port of process 0, for several processes; SLURM and Open MPI give
            it themselves.
        num_processes: Number of processes, with a coordinator.
        process_id: Which of the processes this is, from 0, with a coordinator.
        fsdp: Devices that share one copy of the parameters and the optimizer; 1 keeps a whole copy
            on each.
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
    """Whether this process is the one that writes."""
    return jax.process_index() == 0


def gather(value: Any) -> list[Any]:
    """A JSON value of every process, by process."""
    if jax.process_count() == 1:
        return [value]
    data = np.frombuffer(json.dumps(value).encode(), np.uint8)
    sizes = multihost_utils.process_allgather(np.int32(data.size))
    # Padded to a power of two: every length would be a program of its own.
    padded = np.zeros(1 << (int(sizes.max()) - 1).bit_length(), np.uint8)
    padded[: data.size] = data
    rows = multihost_utils.process_allgather(padded)
    return [json.loads(row[:size].tobytes()) for row, size in zip(rows, sizes, strict=True)]


def run_together(work: Callable[[], T]) -> T:
    """Does something on every process; what goes wrong on one stops them all.

    Raises:
        UserError: that of the first process that had one.
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
    """Does something on the first process; its result, a JSON value, on all of them.

    Raises:
        UserError: that of the first process.
    """
    return gather(run_together(lambda: work() if is_first() else None))[0]


def broadcast(tree: PyTree) -> PyTree:
    """The first process's arrays of NumPy, on all of them; the others pass arrays like them."""
    return multihost_utils.broadcast_one_to_all(tree)
