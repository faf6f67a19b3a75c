"""Where arrays live: one mesh of devices for batches and, if asked for, for parameters.

The mesh has two axes. Batches are split over both; parameters and what the optimizer keeps
of them are whole on every device, or split over the second axis (ZeRO, FSDP).

The cores of a CPU are used best as several devices of their own, each with its share of
the batch: the many small operations of these networks do not split well by themselves
(docs/performance.md). Set `jax_num_cpu_devices` before JAX starts to have them.
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

DATA, FSDP = AXES = "data", "fsdp"  # of every mesh

REPLICATED = PartitionSpec()
SPLIT = PartitionSpec(AXES)  # a batch, by its first dimension
SMALLEST_SPLIT = 1024  # elements; smaller parameters are whole everywhere


def make_mesh(batch: int, devices: Sequence[jax.Device] | None = None, fsdp: int = 1) -> Mesh:
    """A mesh `[data, fsdp]` of as many devices as split a batch evenly.

    Args:
        batch: rows to split.
        devices: to choose from, as many of each process; all of this process, if not given.
        fsdp: over how many devices parameters are split.

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
    """Arrays that every process has, put where their shardings say."""

    def put(leaf: Any, sharding: NamedSharding) -> jax.Array:
        if sharding.is_fully_addressable:
            return jax.device_put(leaf, sharding)
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(put, tree, shardings)


def replicate(tree: PyTree, mesh: Mesh) -> PyTree:
    """The same arrays on every device of the mesh."""
    return place(tree, jax.tree.map(lambda _: NamedSharding(mesh, REPLICATED), tree))


def to_host(tree: PyTree) -> PyTree:
    """Whole arrays of NumPy, on every process; all of them have to ask."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, jax.Array)]
    if all(leaf.is_fully_addressable for leaf in leaves):
        return jax.device_get(tree)
    mesh = leaves[0].sharding.mesh  # type: ignore[attr-defined]  # of a NamedSharding
    whole = _gather_all(mesh)(tree)
    return jax.tree.map(lambda leaf: np.asarray(leaf.addressable_data(0)), whole)


@functools.cache
def _gather_all(mesh: Mesh) -> Callable[[PyTree], PyTree]:
    return jax.jit(lambda tree: tree, out_shardings=NamedSharding(mesh, REPLICATED))


# Parameters, split over the second axis.


def parameter_specs(tree: PyTree, mesh: Mesh) -> PyTree:
    """How each array of a tree of parameters, or of a `TrainState`, is split.

    Along its longest dimension that the second axis divides; whole if there is none, or if
    the array is small.
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
    """`parameter_specs` on their mesh."""
    return jax.tree.map(lambda spec: NamedSharding(mesh, spec), parameter_specs(tree, mesh))


def gather(tree: PyTree, specs: PyTree) -> PyTree:
    """Inside `jax.shard_map`: whole parameters from each device's part."""

    def whole(leaf: jax.Array, spec: PartitionSpec) -> jax.Array:
        if FSDP not in spec:
            return leaf
        return jax.lax.all_gather(leaf, FSDP, axis=spec.index(FSDP), tiled=True)

    return jax.tree.map(whole, tree, specs)


def scatter_mean(tree: PyTree, specs: PyTree) -> PyTree:
    """Inside `jax.shard_map`: each device's part of the mean of whole gradients."""

    def part(leaf: jax.Array, spec: PartitionSpec) -> jax.Array:
        if FSDP not in spec:
            return leaf
        dimension = spec.index(FSDP)
        total = jax.lax.psum_scatter(leaf, FSDP, scatter_dimension=dimension, tiled=True)
        return total / jax.lax.axis_size(FSDP)

    parts, structure = jax.tree.flatten(jax.tree.map(part, tree, specs))
    split = [FSDP in spec for spec in jax.tree.leaves(specs)]
    # One message instead of one for each array: between processes each costs its latency.
    for axes, chosen in ((AXES, False), ((DATA,), True)):
        places = [place for place, is_split in enumerate(split) if is_split == chosen]
        flat, unflatten = ravel_pytree([parts[place] for place in places])
        means = unflatten(jax.lax.pmean(flat, axes))
        for place, mean in zip(places, means, strict=True):
            parts[place] = mean
    return jax.tree.unflatten(structure, parts)


def quick(mesh: Mesh) -> dict[str, Any] | None:
    """Options for a program that is compiled for one call, on the devices of a mesh."""
    if mesh.devices.flat[0].platform != "cpu":
        return None
    return {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def alone(mesh: Mesh) -> dict[str, Any] | None:
    """Options for a program on the devices of a mesh: where each is a core, it stays on its own.

    A matrix product that asks other cores for help only waits for them; and for ever, where they
    wait for this one at an exchange between devices.
    """
    cores = os.cpu_count() or 1
    on_cores = mesh.devices.flat[0].platform == "cpu" and mesh.size > 1 and mesh.size >= cores
    return {"xla_cpu_multi_thread_eigen": False} if on_cores else None


def split_batches(function: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """Jits `(static, params, *batches) -> batch` so that each device does its own rows."""

    def program(static: Hashable, params: PyTree, *batches: PyTree) -> PyTree:
        rows = jax.shard_map(
            functools.partial(function, static), mesh=mesh, out_specs=SPLIT,
            in_specs=(REPLICATED, *(SPLIT for _ in batches)), check_vma=False,
        )  # fmt: skip
        return rows(params, *batches)

    return jax.jit(program, static_argnums=0, compiler_options=alone(mesh))
