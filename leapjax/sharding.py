"""Where arrays live: one mesh of devices, over which batches are split.

The cores of a CPU are used best as several devices of their own, each with its share of
the batch: the many small operations of these networks do not split well by themselves
(docs/performance.md). Set `jax_num_cpu_devices` before JAX starts to have them.
"""

import functools
import os
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from leapjax.types import PyTree

DATA = "data"  # the mesh axis that splits a batch

REPLICATED = PartitionSpec()
SPLIT = PartitionSpec(DATA)


def data_mesh(batch: int, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh of as many devices as split a batch evenly; of this process, if not given."""
    devices = jax.local_devices() if devices is None else devices
    if not devices:
        raise ValueError("a mesh needs at least one device, got none")
    count = max(n for n in range(1, len(devices) + 1) if batch % n == 0)
    return Mesh(np.array(devices[:count]), (DATA,))


def replicate(tree: PyTree, mesh: Mesh) -> PyTree:
    """The same arrays on every device of the mesh."""
    return jax.device_put(tree, NamedSharding(mesh, REPLICATED))


def split_batches(function: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """Jits `(static, params, *batches) -> batch` so that each device does its own rows."""

    def program(static: Hashable, params: PyTree, *batches: PyTree) -> PyTree:
        rows = jax.shard_map(
            functools.partial(function, static), mesh=mesh, out_specs=SPLIT,
            in_specs=(REPLICATED, *(SPLIT for _ in batches)), check_vma=False,
        )  # fmt: skip
        return rows(params, *batches)

    # Where every core is a device, matrix products that ask other cores for help only wait.
    cores = os.cpu_count() or 1
    alone = mesh.size > 1 and mesh.devices.flat[0].platform == "cpu" and mesh.size >= cores
    options = {"xla_cpu_multi_thread_eigen": False} if alone else None
    return jax.jit(program, static_argnums=0, compiler_options=options)
