"""Where arrays live: one mesh of devices for batches and, if asked for, for parameters.

The mesh has two axes. Both split batches. Parameters and the optimizer's state are whole on every
device, or the second axis splits them (ZeRO, FSDP).

A CPU is fastest with one device for each core, because the many small operations of these networks
do not split well (docs/performance.md). Set `jax_num_cpu_devices` before JAX starts.
"""

import functools
import math
import os
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from leapjax.checks import check_integer
from leapjax.types import PyTree

DATA, FSDP = AXES = "data", "fsdp"  # axes of every mesh

REPLICATED = PartitionSpec()
SPLIT = PartitionSpec(AXES)  # a batch, by its first dimension
SMALLEST_SPLIT = 1024  # elements; smaller parameters are whole everywhere


def make_mesh(batch: int, devices: Sequence[jax.Device] | None = None, fsdp: int = 1) -> Mesh:
    """Makes a mesh `[data, fsdp]` of as many devices as split a batch evenly.

    Args:
        batch: number of rows to split.
        devices: devices to choose from, equally many of each process; `None`: all of this process.
        fsdp: number of devices that split the parameters.

    Raises:
        ValueError: no number of these devices splits the batch, or makes whole groups of `fsdp`.
    """
    batch, fsdp = check_integer("batch", batch, 1), check_integer("fsdp", fsdp, 1)
    devices = jax.local_devices() if devices is None else devices
    if not isinstance(devices, Sequence) or not all(isinstance(d, jax.Device) for d in devices):
        raise ValueError(f"devices must be a sequence such as jax.devices(), got {devices!r}")
    if not devices:
        raise ValueError("a mesh needs at least one device, got none")
    groups: dict[int, list[jax.Device]] = {}
    for device in devices:
        groups.setdefault(device.process_index, []).append(device)
    most = min(len(group) for group in groups.values())
    for each in range(most, 0, -1):
        count = each * len(groups)
        if batch % count == 0 and count % fsdp == 0:
            chosen = [device for index in sorted(groups) for device in groups[index][:each]]
            return Mesh(np.array(chosen).reshape(count // fsdp, fsdp), AXES)
    raise ValueError(
        f"a batch of {batch} and parameters split in {fsdp} do not fit {len(groups)} process(es) "
        f"of {most} device(s): the devices used must divide the batch, and be a multiple of {fsdp}"
    )


def place(tree: PyTree, shardings: PyTree) -> PyTree:
    """Puts arrays, which every process has, on the devices of their shardings."""

    def put(leaf: Any, sharding: NamedSharding) -> jax.Array:
        if sharding.is_fully_addressable:
            return jax.device_put(leaf, sharding)
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(put, tree, shardings)


def replicate(tree: PyTree, mesh: Mesh) -> PyTree:
    """Copies arrays to every device of a mesh."""
    return place(tree, jax.tree.map(lambda _: NamedSharding(mesh, REPLICATED), tree))


def to_host(tree: PyTree) -> PyTree:
    """Returns whole NumPy arrays. Every process must call it, and gets them."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, jax.Array)]
    if all(leaf.is_fully_addressable for leaf in leaves):
        return jax.device_get(tree)
    mesh = leaves[0].sharding.mesh  # type: ignore[attr-defined]  # of a NamedSharding
    whole = _gather_all(mesh)(tree)
    return jax.tree.map(lambda leaf: np.asarray(leaf.addressable_data(0)), whole)


@functools.cache
def _gather_all(mesh: Mesh) -> Callable[[PyTree], PyTree]:
    return jax.jit(lambda tree: tree, out_shardings=NamedSharding(mesh, REPLICATED))


# Parameters, which the second axis splits.


def parameter_specs(tree: PyTree, mesh: Mesh) -> PyTree:
    """Returns how the mesh splits each array of a tree, such as parameters or a `TrainState`.

    It splits the longest dimension that the second axis divides. Small arrays stay whole, and so do
    arrays without such a dimension.
    """
    count = mesh.shape[FSDP]

    def spec(leaf: Any) -> PartitionSpec:
        fitting = [d for d, size in enumerate(leaf.shape) if size % count == 0]
        if count == 1 or not fitting or math.prod(leaf.shape) < SMALLEST_SPLIT:
            return REPLICATED
        dimension = max(fitting, key=lambda d: leaf.shape[d])
        return PartitionSpec(*(None,) * dimension, FSDP)

    return jax.tree.map(spec, tree)


def parameter_shardings(tree: PyTree, mesh: Mesh) -> PyTree:
    """Returns `parameter_specs` as shardings of the mesh."""
    return jax.tree.map(lambda spec: NamedSharding(mesh, spec), parameter_specs(tree, mesh))


def gather(tree: PyTree, specs: PyTree) -> PyTree:
    """Gathers whole parameters from each device's part, inside `jax.shard_map`."""

    def whole(leaf: jax.Array, spec: PartitionSpec) -> jax.Array:
        if FSDP not in spec:
            return leaf
        return jax.lax.all_gather(leaf, FSDP, axis=spec.index(FSDP), tiled=True)

    return jax.tree.map(whole, tree, specs)


def scatter_mean(tree: PyTree, specs: PyTree) -> PyTree:
    """Averages gradients, and keeps each device's part, inside `jax.shard_map`."""

    def part(leaf: jax.Array, spec: PartitionSpec) -> jax.Array:
        if FSDP not in spec:
            return leaf
        dimension = spec.index(FSDP)
        total = jax.lax.psum_scatter(leaf, FSDP, scatter_dimension=dimension, tiled=True)
        return total / jax.lax.axis_size(FSDP)

    parts, structure = jax.tree.flatten(jax.tree.map(part, tree, specs))
    split = [FSDP in spec for spec in jax.tree.leaves(specs)]
    # One message for all arrays: between processes each message costs its latency.
    for axes, chosen in ((AXES, False), ((DATA,), True)):
        places = [place for place, is_split in enumerate(split) if is_split == chosen]
        flat, unflatten = ravel_pytree([parts[place] for place in places])
        means = unflatten(jax.lax.pmean(flat, axes))
        for place, mean in zip(places, means, strict=True):
            parts[place] = mean
    return jax.tree.unflatten(structure, parts)


def choose_quick_options(mesh: Mesh) -> dict[str, Any] | None:
    """Chooses compiler options for a program that runs once: it compiles fast, and runs slowly."""
    if mesh.devices.flat[0].platform != "cpu":
        return None
    return {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def choose_core_options(mesh: Mesh) -> dict[str, Any] | None:
    """Chooses compiler options that keep each device on its own core, if devices are cores.

    A matrix product that uses other cores would wait for them. It would wait for ever if they wait
    for its device at an exchange.
    """
    cores = os.cpu_count() or 1
    on_cores = mesh.devices.flat[0].platform == "cpu" and mesh.size > 1 and mesh.size >= cores
    return {"xla_cpu_multi_thread_eigen": False} if on_cores else None


def split_batches(function: Callable[..., Any], mesh: Mesh) -> jax.stages.Wrapped:
    """Jits `(static, params, *batches) -> batch`, so that each device computes its own rows."""

    def program(static: Hashable, params: PyTree, *batches: PyTree) -> PyTree:
        rows = jax.shard_map(
            functools.partial(function, static), mesh=mesh, out_specs=SPLIT,
            in_specs=(REPLICATED, *(SPLIT for _ in batches)), check_vma=False,
        )  # fmt: skip
        return rows(params, *batches)

    return jax.jit(program, static_argnums=0, compiler_options=choose_core_options(mesh))
