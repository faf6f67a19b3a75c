"""Weak scaling of training over devices and processes: `python -m benchmarks.scaling`.

Each device takes the same number of windows per step. Each setting runs in its own processes,
because JAX fixes its devices when it starts. More virtual devices than cores show only the cost of
splitting.
"""

import dataclasses
import json
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.timing import Row, check_writable, fastest, write_rows
from benchmarks.training import Stepper
from leapjax import processes, sharding
from leapjax.errors import UserError
from leapjax.presets import find_preset
from leapjax.running import jax_setup, shell
from leapjax.running.jax_setup import Cluster

# (processes, devices of each, devices that share parameters)
SETTINGS = ((1, 1, 1), (1, 2, 1), (2, 1, 1), (1, 2, 2), (1, 4, 1), (1, 8, 1), (1, 8, 8))


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure weak scaling."""

    level: str = "GoToLocalS7N5"
    """Level to train on, with preset `leapjax`."""
    per_device: int = 32
    """Windows per device and step."""
    seconds: float = 5.0
    """Least time for each measurement."""
    json: Path | None = None
    """Write the rows here."""
    worker: bool = False
    """Measure in this process, on its devices, and print the row."""
    cluster: Annotated[Cluster, tyro.conf.arg(name="")] = Cluster()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes the rows to `--json`; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "benchmarks.scaling", given)
    return shell.run_program("benchmarks.scaling", given, lambda: run(options, given))


def run(options: Options, arguments: list[str]) -> None:
    """Measures every setting, or with `worker` this process's setting."""
    find_preset("babyai", options.level, "leap", "leapjax")  # raises if the level is unknown
    check_writable(options.json)
    if options.worker:
        jax_setup.start(options.cluster, cache=False)
        row = measure(options)
        if processes.is_first():
            print(json.dumps(row), flush=True)
        return
    rows = [launch(arguments, *setting) for setting in SETTINGS]
    Console().print(table(rows))
    write_rows(options.json, rows)


def launch(arguments: list[str], count: int, devices: int, fsdp: int) -> Row:
    """Measures one setting in new processes; returns its row.

    Raises:
        UserError: a process failed.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "benchmarks.scaling", *arguments, "--worker"]
    command += ["--fsdp", str(fsdp)]
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": str(devices)}
    workers = []
    for index in range(count):
        joined = ["--coordinator", f"localhost:{port}", "--num-processes", str(count)]
        joined += ["--process-id", str(index)]
        workers.append(
            subprocess.Popen(
                command + (joined if count > 1 else []),
                env=environment,
                text=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
            )
        )
    outputs = [worker.communicate() for worker in workers]
    for worker, (_, error) in zip(workers, outputs, strict=True):
        if worker.returncode:
            last = (error.strip() or "no message").splitlines()[-1]
            raise UserError(f"{count} processes of {devices} devices: {last}")
    return json.loads(outputs[0][0].strip().splitlines()[-1])


def measure(options: Options) -> Row:
    """Measures one setting on all devices of all processes."""
    config = find_preset("babyai", options.level, "leap", "leapjax")
    batch = options.per_device * jax.device_count()
    chosen = dataclasses.replace(config.training, batch=batch)
    mesh = sharding.make_mesh(batch, jax.devices(), options.cluster.fsdp)
    advance = Stepper(dataclasses.replace(config, training=chosen), mesh)

    # All processes must take the same number of steps: the slowest clock decides.
    for _ in range(3):
        jax.block_until_ready(advance())
    repeats = max(processes.gather(int(options.seconds / fastest(advance, 0) / 5) + 1))
    taken = min(fastest(lambda: [advance() for _ in range(5)], 0) / 5 for _ in range(repeats))

    communicate = partial(exchange(advance.state.params, mesh), advance.state.params)
    jax.block_until_ready(communicate())
    alone = min(fastest(communicate, 0) for _ in range(50))
    parameters = sum(leaf.size for leaf in jax.tree.leaves(advance.state.params))
    return {
        "level": options.level,
        "processes": jax.process_count(),
        "devices": jax.device_count(),
        "fsdp": options.cluster.fsdp,
        "per_device": options.per_device,
        "seconds_per_step": taken,
        "examples_per_second": batch / taken,
        "exchange_seconds": alone,
        "parameters": int(parameters),
    }


def exchange(params: Any, mesh: jax.sharding.Mesh) -> Any:
    """Compiles the communication of one step: gather parameters, average gradients."""
    specs = sharding.parameter_specs(params, mesh)

    def on_each_device(parts: Any) -> Any:
        return sharding.scatter_mean(sharding.gather(parts, specs), specs)

    return jax.jit(
        jax.shard_map(
            on_each_device, mesh=mesh, in_specs=(specs,), out_specs=specs, check_vma=False
        )
    )


def table(rows: Sequence[Row]) -> Table:
    """Makes a table of the rows for a terminal."""
    result = Table(
        "processes", "devices", "fsdp", "ms/step", "examples/s", "of two devices", "exchange (ms)"
    )
    best = [r["examples_per_second"] for r in rows if (r["processes"], r["devices"]) == (1, 2)]
    for row in rows:
        result.add_row(
            str(row["processes"]),
            str(row["devices"]),
            str(row["fsdp"]),
            f"{1e3 * row['seconds_per_step']:.1f}",
            f"{row['examples_per_second']:.0f}",
            f"{row['examples_per_second'] / np.max(best):.0%}" if best else "",
            f"{1e3 * row['exchange_seconds']:.1f}",
        )
    return result


if __name__ == "__main__":
    sys.exit(main())
