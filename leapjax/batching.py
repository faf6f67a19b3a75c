"""Planners for batches: cut into chunks of a few sizes, jitted, and split over devices."""

import operator
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from leapjax import compilation, sharding
from leapjax.checks import check_counts, check_integer, check_kind, check_seed, check_seeds
from leapjax.errors import UserError
from leapjax.planners import PlannerConfig, find_planner
from leapjax.planners.configs import passes_vary
from leapjax.types import Array, EncodeNext, Energy, Params, Plan, PyTree

CHUNK_SIZES = (1, 16, 128)
# The same where the number of passes varies, as a chunk waits for its last plan. On hard boards of
# Sudoku, with restarts, that takes 29 s of CPU time, 35 s in chunks of 8, 71 s in chunks of 32.
VARYING_CHUNK_SIZES = (1, 4)
KEYS = "threefry2x32"  # kind of all keys made here, whatever JAX's default is


class NotANumber(ValueError):
    """An energy was NaN or -inf during planning.

    Attributes:
        plan: the plans made anyway, as NumPy arrays; `plan.valid` marks the rows to trust.
    """

    def __init__(self, message: str, plan: Plan) -> None:
        super().__init__(message, plan)
        self.plan = plan

    def __str__(self) -> str:
        return self.args[0]


class CompiledPlanner:
    """A jitted planner for batches of any size; made by `compile_planner`.

    It keeps a reference to the parameters of its last call.

    Attributes:
        chunk_sizes: allowed numbers of plans in a call of the compiled function, ascending.
        num_actions: A of the energy, the end action included.
    """

    def __init__(
        self,
        energy: Energy,
        config: PlannerConfig,
        chunk_sizes: Sequence[int],
        devices: Sequence[jax.Device] | None,
        encode_next: EncodeNext | None,
    ) -> None:
        self.chunk_sizes = tuple(sorted({*check_counts("chunk sizes", chunk_sizes, 1).tolist()}))
        if not self.chunk_sizes:
            raise ValueError("chunk sizes: expected at least one")
        planner = find_planner(config)
        self.num_actions = check_kind(energy, Energy).num_actions

        def plan_one(
            params: Params, key: jax.Array, context: PyTree, cache: PyTree
        ) -> tuple[Plan, PyTree]:
            if encode_next is None:
                memory, cache = energy.encode(params, context), None
            else:
                memory, cache = encode_next(params, context, cache)
            return planner(energy, params, key, memory, config), cache

        def plan_rows(
            kind: str, params: Params, key_data: jax.Array, contexts: PyTree, cache: PyTree
        ) -> tuple[Plan, PyTree]:
            keys = jax.random.wrap_key_data(key_data, impl=kind)
            return jax.vmap(plan_one, in_axes=(None, 0, 0, 0))(params, keys, contexts, cache)

        nothing = jax.tree.structure(())
        self._last: tuple[list[Array], Any, dict[int, Params]] = ([], nothing, {})
        # Plans are independent, so each device plans its rows by itself.
        self._meshes = {size: sharding.make_mesh(size, devices) for size in self.chunk_sizes}
        self._programs = {
            mesh.size: sharding.split_batches(plan_rows, mesh) for mesh in self._meshes.values()
        }

    def __call__(self, params: Params, keys: Array, contexts: PyTree) -> Plan:
        """Plans for B contexts.

        Args:
            params: parameters of the energy.
            keys: `[B]`, or raw `[B, 2]` uint32 from `plan_keys`.
            contexts: leaves with a leading `[B]`.

        Returns:
            A `Plan` of NumPy arrays with a leading `[B]`.

        Raises:
            ValueError: There are no contexts, or not as many as keys. Contexts are not numbers.
                64-bit contexts or parameters do not fit 32 bits. The call is inside `jit`, `vmap`
                or `grad`.
            NotANumber: the energy of some action was NaN or -inf; the exception holds the plans.
        """
        return self.plan_next(params, keys, contexts, None)[0]

    def plan_next(
        self, params: Params, keys: Array, contexts: PyTree, cache: PyTree
    ) -> tuple[Plan, PyTree]:
        """Plans for B contexts, and returns a cache for the contexts one action later.

        Args:
            params: as in `__call__`.
            keys: as in `__call__`.
            contexts: as in `__call__`.
            cache: returned with the plans one action earlier, a row for each context. `None` at the
                start of episodes, or after states without a plan.

        Returns:
            The plans, and the cache: opaque NumPy arrays with a leading `[B]`, or `None` if the
            planner has no `encode_next`.

        Raises:
            ValueError: as in `__call__`.
            NotANumber: as in `__call__`.
        """
        kind, inputs = _check_inputs(params, keys, contexts, cache)
        batch = inputs[0].shape[0]
        chunks = split_batch(batch, self.chunk_sizes)
        placed = self._place(params, {self._meshes[size] for _, size, _ in chunks})
        plans = []
        for start, size, _ in chunks:
            # The last chunk repeats its last row until it is full. The copies are cut off below.
            rows = np.minimum(np.arange(start, start + size), batch - 1)
            count = self._meshes[size].size
            chunk = jax.tree.map(lambda leaf, r=rows: leaf[r], inputs)
            plans.append(self._programs[count](kind, placed[count], *chunk))
        parts = [
            jax.tree.map(lambda leaf, n=used: np.asarray(leaf)[:n], plan)
            for plan, (_, _, used) in zip(plans, chunks, strict=True)
        ]
        plan, cache = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
        if not plan.valid.all():
            raise NotANumber(
                f"the energy is NaN or -inf for {np.sum(~plan.valid)} of {batch} contexts (the "
                f"first is context {np.argmin(plan.valid)}): look at the parameters, and at logits "
                "that are +inf or all -inf",
                plan,
            )
        return plan, cache

    def _place(self, params: Params, meshes: set[Mesh]) -> dict[int, Params]:
        """Places the parameters on the devices of each mesh, and returns them by mesh size.

        Placing costs more than a single plan. So the placed parameters are reused while callers
        pass the same JAX arrays. NumPy arrays can be written to, so they are placed in each call.
        """
        leaves, structure = jax.tree.flatten(params)
        last, last_structure, placed = self._last
        same = structure == last_structure and all(map(operator.is_, leaves, last))
        if not same or not all(isinstance(leaf, jax.Array) for leaf in leaves):
            placed = {}
        missing = {mesh for mesh in meshes if mesh.size not in placed}
        if missing:
            check_fit("params", params)
            placed = placed | {mesh.size: sharding.replicate(params, mesh) for mesh in missing}
            self._last = leaves, structure, placed  # one assignment, for other threads
        return placed

    def compile(self, params: Params, context: PyTree, batch: int = 1, again: bool = True) -> None:
        """Compiles the programs for up to `batch` plans, so that later calls start at once.

        Args:
            params: parameters of the energy; only their shapes and types matter.
            context: context of one plan, without a leading `[B]`; only shapes and types matter.
            batch: B, the largest number of contexts in a call.
            again: whether to compile plans with a cache too, for later plans of an episode (see
                `plan_next`).

        Raises:
            ValueError: `batch` is not positive; or as in `__call__`.
        """
        for size in self.sizes_up_to(check_integer("batch", batch, 1)):
            contexts = jax.tree.map(lambda leaf, n=size: np.stack([np.asarray(leaf)] * n), context)
            keys = plan_keys(0, np.arange(size), np.zeros(size, int))
            kind, inputs = _check_inputs(params, keys, contexts, None)
            mesh = self._meshes[size]
            placed, program = self._place(params, {mesh})[mesh.size], self._programs[mesh.size]
            first = program.lower(kind, placed, *inputs)
            first.compile()  # a call then finds the program
            cache = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), first.out_info[1])
            if again and cache is not None:
                program.lower(kind, placed, *inputs[:2], cache).compile()

    def sizes_up_to(self, batch: int) -> list[int]:
        """Lists the chunk sizes that batches of at most `batch` plans can need."""
        batches = range(1, min(batch, 2 * self.chunk_sizes[-1]) + 1)
        return sorted({size for b in batches for _, size, _ in split_batch(b, self.chunk_sizes)})


def compile_planner(
    energy: Energy,
    config: PlannerConfig,
    chunk_sizes: Sequence[int] | None = None,
    devices: Sequence[jax.Device] | None = None,
    encode_next: EncodeNext | None = None,
) -> CompiledPlanner:
    """Builds a planner for batches of any size; build it once.

    A batch is split into chunks of a few fixed sizes. Each size compiles at its first use, or ahead
    with `CompiledPlanner.compile`. A chunk fits the processor's cache, and only the last chunk is
    padded. All chunks are dispatched before the first result is awaited.

    Compiled programs are kept on disk, in the user's cache folder, unless JAX has a cache already
    (`jax_compilation_cache_dir`). `LEAPJAX_COMPILATION_CACHE` names another folder, or is "off".

    Args:
        energy: energy to minimise.
        config: settings of the planner. Their class chooses `gibbs`, `random_shooting`,
            `cross_entropy_method` or `beam_search`.
        chunk_sizes: allowed numbers of plans in a call of the compiled function. A chunk is split
            over as many devices as divide its size. By default 1, 16 and 128; or 1 and 4, if some
            plans take fewer passes than others.
        devices: devices to plan on; `None` for all devices of this process.
        encode_next: `energy.encode` with a cache, such as `Agent.encode_next`; `None`: each context
            is encoded as a whole.

    Raises:
        TypeError: no planner takes such a `config`.
        ValueError: a chunk size is not positive.
    """
    compilation.use_disk_cache()
    if chunk_sizes is None:
        chunk_sizes = VARYING_CHUNK_SIZES if passes_vary(config) else CHUNK_SIZES
    return CompiledPlanner(energy, config, chunk_sizes, devices, encode_next)


def split_batch(batch: int, sizes: Sequence[int]) -> list[tuple[int, int, int]]:
    """Splits a batch into chunks `(start, size, rows used)`, greedily from the largest size.

    The remainder is padded to the next size if it fills more than 80% of that size. It is also
    padded if it would take more than four chunks of the smallest size: a single plan takes about a
    quarter of the time of sixteen plans.

    Args:
        batch: number of plans.
        sizes: chunk sizes, ascending.
    """
    chunks: list[tuple[int, int, int]] = []
    start = 0
    while start < batch:
        left = batch - start
        fitting = [size for size in sizes if size <= left]
        larger = [size for size in sizes if size > left]
        size = fitting[-1] if fitting else larger[0]
        nearly_full = bool(larger) and left > 0.8 * larger[0]
        one_by_one = bool(larger) and size == sizes[0] and left > 4 * size
        if nearly_full or one_by_one:
            size = larger[0]
        chunks.append((start, size, min(size, left)))
        start += size
    return chunks


def _check_inputs(
    params: Params, keys: Array, contexts: PyTree, cache: PyTree
) -> tuple[str, tuple[Array, PyTree, PyTree]]:
    """Checks the arguments of `CompiledPlanner.plan_next`.

    Returns:
        The kind of the keys, and raw keys, contexts and cache as NumPy arrays.

    Raises:
        ValueError: as in `CompiledPlanner.__call__`.
    """
    leaves = jax.tree.leaves((params, keys, contexts))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        raise UserError(
            "a compiled planner was called inside of jit, vmap or grad, where it sees no "
            "numbers: call it outside, or use leap.gibbs (or the planner of its "
            "configuration) there, with jax.vmap over keys and what energy.encode returns"
        )
    if not hasattr(keys, "dtype"):
        if not isinstance(keys, Sequence) or isinstance(keys, str):
            raise UserError(f"keys must be an array, one for each context, got {keys!r}")
        if not len(keys):
            raise ValueError("no contexts to plan for")
        keys = jnp.stack([jnp.asarray(key) for key in keys])
    typed = jnp.issubdtype(keys.dtype, jax.dtypes.prng_key)
    if keys.ndim != (1 if typed else 2):
        raise ValueError(
            f"keys of shape {keys.shape}: expected one for each context, as "
            "jax.random.split(key, B) makes them"
        )
    batch = keys.shape[0]
    if batch == 0:
        raise ValueError("no contexts to plan for")
    if any(leaf.shape[0] != batch for leaf in jax.tree.leaves(cache)):
        raise UserError(f"the cache must have a row for each of the {batch} contexts")
    for path, leaf in jax.tree.leaves_with_path(contexts):
        if np.ndim(leaf) == 0 or leaf.shape[0] != batch:
            raise ValueError(
                f"context{jax.tree_util.keystr(path)} has shape {np.shape(leaf)}: its first "
                f"dimension must be the number of keys, {batch}"
            )
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            raise UserError(
                f"context{jax.tree_util.keystr(path)} holds random keys: pass "
                "jax.random.key_data(keys), and wrap_key_data in the energy"
            )
        if not isinstance(leaf, jax.Array) and not _is_real(np.asarray(leaf).dtype):
            raise ValueError(
                f"context{jax.tree_util.keystr(path)} holds {np.asarray(leaf).dtype}, not "
                "numbers: encode it first"
            )
    check_fit("context", contexts)
    # Slice with NumPy: JAX would compile a program for each slice of a device array.
    if typed:
        kind, keys = str(jax.random.key_impl(keys)), jax.random.key_data(keys)
    else:
        kind = _name_kind(keys)
    inputs = jax.tree.map(np.asarray, (keys, contexts, cache))
    return kind, inputs


def _is_real(dtype: np.dtype) -> bool:
    """Says whether JAX computes with a type or its shorter equivalent: reals and booleans."""
    kinds = (np.bool_, np.integer, jnp.floating)
    return dtype.itemsize <= 8 and any(jnp.issubdtype(dtype, kind) for kind in kinds)


def check_fit(name: str, tree: PyTree) -> None:
    """Checks that JAX, which computes with 32 bits, will only round the numbers of a tree.

    Args:
        name: name of the tree, for the message.
        tree: arrays of numbers; JAX arrays always pass.

    Raises:
        UserError: a leaf holds no numbers, or one that does not fit; the message names the first.
    """
    for path, leaf in jax.tree.leaves_with_path(tree):
        if isinstance(leaf, jax.Array):
            continue
        array = np.asarray(leaf)
        if array.dtype.kind in "OSUmM":
            raise UserError(f"{name}{jax.tree_util.keystr(path)} holds {array.dtype}, not numbers")
        if array.dtype.kind not in "iuf" or not array.size:
            continue
        narrow = jax.dtypes.canonicalize_dtype(array.dtype)
        if narrow == array.dtype:
            continue
        limits: Any = np.finfo(narrow) if narrow.kind == "f" else np.iinfo(narrow)
        least, most = (x.item() if narrow.kind == "f" else x for x in (limits.min, limits.max))
        if array.min() >= least and array.max() <= most:
            continue
        wrong = array[((array < least) | (array > most)) & np.isfinite(array)]
        if wrong.size:
            raise UserError(
                f"{name}{jax.tree_util.keystr(path)} holds {wrong[0]}, which does not fit "
                f"{narrow}, the numbers that JAX computes with"
            )


def _name_kind(keys: Array) -> str:
    """Names the kind of raw keys `[B, width]`: `KEYS` if the width is 2, else JAX's default.

    Raises:
        UserError: neither kind has keys of this type and width.
    """
    if keys.dtype == np.uint32 and keys.shape[1] == 2:
        return KEYS
    if keys.dtype == np.uint32 and keys.shape[1:] == jax.random.PRNGKey(0).shape:
        return str(jax.config.jax_default_prng_impl)  # type: ignore[attr-defined]
    raise UserError(
        f"raw keys must be [B, 2] uint32, as plan_keys makes them, got {keys.shape} {keys.dtype}"
    )


def planner_key(seed: int) -> jax.Array:
    """Makes the key from which all plans of a seed derive their keys.

    Raises:
        UserError: `seed` is not a seed; see `leapjax.checks.check_seed`.
    """
    return jax.random.key(check_seed(seed), impl=KEYS)


def plan_keys(seed: int, episodes: np.ndarray, replans: np.ndarray) -> np.ndarray:
    """Makes raw keys `[B, 2]` uint32 from (seed, episode, replan index), whatever the row.

    Args:
        seed: seed of all plans.
        episodes: `[B]` episode of each plan, such as its level seed.
        replans: `[B]` number of earlier plans of the episode.

    Raises:
        UserError: a value is not an integer in 0 .. 2^32 - 1, or `episodes` and `replans` differ in
            length.
    """
    key = planner_key(seed)
    episodes = check_seeds(_convert_whole(episodes), "episode")
    replans = check_seeds(_convert_whole(replans), "replan")
    batch = len(episodes)
    if len(replans) != batch:
        raise UserError(f"{batch} episodes, but {len(replans)} replans: expected one for each")
    if batch == 0:
        return np.zeros((0, 2), np.uint32)
    # Pad to a power of two, so that a shrinking batch does not compile at every size.
    rows = np.minimum(np.arange(1 << (batch - 1).bit_length()), batch - 1)
    folded = np.stack([episodes, replans])[:, rows]
    return np.asarray(_fold_in(key, folded))[:batch]


def _convert_whole(values: np.ndarray) -> np.ndarray:
    """Converts floats to integers if all are whole, so that `np.zeros(B)` means B zeros."""
    if isinstance(values, np.ndarray) and values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            integers = values.astype(np.int64)
        return integers if np.array_equal(integers, values) else values
    return values


def plan_key(key: jax.Array, episode: jax.Array, replan: jax.Array) -> jax.Array:
    """Derives the key of one plan, inside a program; see `plan_keys`."""
    return jax.random.fold_in(jax.random.fold_in(key, episode), replan)


@jax.jit
def _fold_in(key: jax.Array, indices: jax.Array) -> jax.Array:
    """Derives key data `[B, 2]` from one key and indices `[2, B]`."""

    def fold(episode: jax.Array, replan: jax.Array) -> jax.Array:
        return jax.random.key_data(plan_key(key, episode, replan))

    return jax.vmap(fold)(*indices)
