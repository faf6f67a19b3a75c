"""Which processes and devices share a run."""

import dataclasses

from leapjax.checks import check_at_least, check_types

LAST_PORT = 2**16 - 1


@dataclasses.dataclass(frozen=True)
class Cluster:
    """The processes and devices that share a run."""

    coordinator: str | None = None
    """host:port of process 0, for several processes; SLURM and Open MPI say it themselves."""
    num_processes: int | None = None
    """With a coordinator: how many processes there are."""
    process_id: int | None = None
    """With a coordinator: which of them this is, from 0."""
    fsdp: int = 1
    """Split parameters and optimizer over groups of so many devices; 1: whole on each."""

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
