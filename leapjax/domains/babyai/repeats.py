"""Maps a function over sequences, and calls it once for repeated elements.

States repeat for several steps, for example before an episode begins.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from leapjax.types import PyTree


def map_repeats(
    function: Callable[[PyTree, jax.Array], jax.Array],
    sequences: PyTree,
    rows: jax.Array,
    size: int,
) -> jax.Array:
    """Applies a function to B sequences of n elements: `[B, n, ...]`.

    It calls the function once for equal consecutive elements of a sequence. The number of calls
    depends on the data, so a loop of variable length makes them. JAX cannot differentiate such a
    loop, so this module defines its gradient.

    Args:
        function: (element, row of its sequence) -> array. It may capture arrays of floating-point
            numbers, such as parameters.
        sequences: leaves `[B, n, ...]` of any type, n > 0, without gradients.
        rows: floating-point numbers `[B, ...]`, a row for each sequence.
        size: elements in a call. The gradient calls the function again, because storing the
            intermediate values costs more.
    """
    first, total, which = _find_repeats(sequences)
    # The arrays have room for all elements; the first element fills the unused end.
    first = jnp.pad(first, (0, -len(first) % size)).reshape(-1, size)
    things = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[first], sequences)
    rows = rows[first // which.shape[1]]
    each, captured = jax.closure_convert(jax.vmap(function), *_at((things, rows), 0))
    found = _map_parts(each, things, (total + size - 1) // size, rows, captured)
    return found.reshape(-1, *found.shape[2:])[which]


def _find_repeats(sequences: PyTree) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds groups of equal consecutive elements along axis 1.

    Returns:
        Indices `[B * n]` of the groups' first elements among all B * n elements, then zeros; the
        number `[]` of groups; and the group `[B, n]` of each element.
    """

    def differs(leaf: jax.Array) -> jax.Array:
        return jnp.any(leaf[:, 1:] != leaf[:, :-1], axis=range(2, leaf.ndim))

    changed = jax.tree.reduce(jnp.logical_or, jax.tree.map(differs, sequences))  # [B, n - 1]
    new = jnp.pad(changed, ((0, 0), (1, 0)), constant_values=True)
    first = jnp.nonzero(new.reshape(-1), size=new.size)[0]
    return first, jnp.sum(new), (jnp.cumsum(new) - 1).reshape(new.shape)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _map_parts(
    each: Callable[..., jax.Array], things: PyTree, count: jax.Array, rows: PyTree, captured: list
) -> jax.Array:
    """Applies `each` to the first `count []` of P parts; returns `[P, ...]`, zeros for the rest."""

    def step(part: jax.Array, found: jax.Array) -> jax.Array:
        return _put(found, each(*_at((things, rows), part), *captured), part)

    one = jax.eval_shape(each, *_at((things, rows), 0), *captured)
    parts = jax.tree.leaves(things)[0].shape[0]
    return jax.lax.fori_loop(0, count, step, jnp.zeros((parts, *one.shape), one.dtype))


def _forward(
    each: Callable[..., jax.Array], *given: PyTree
) -> tuple[jax.Array, tuple[PyTree, ...]]:
    return _map_parts(each, *given), given


def _backward(
    each: Callable[..., jax.Array], given: tuple[PyTree, ...], gradient: jax.Array
) -> tuple[None, None, PyTree, list]:
    things, count, rows, captured = given

    def step(part: jax.Array, totals: tuple[PyTree, list]) -> tuple[PyTree, list]:
        thing, row, cotangent = _at((things, rows, gradient), part)
        _, pull_back = jax.vjp(functools.partial(each, thing), row, *captured)
        of_row, *of_captured = pull_back(cotangent)
        by_rows, by_captured = totals
        return _put(by_rows, of_row, part), jax.tree.map(jnp.add, by_captured, of_captured)

    nothing = jax.tree.map(jnp.zeros_like, (rows, captured))
    return None, None, *jax.lax.fori_loop(0, count, step, nothing)


_map_parts.defvjp(_forward, _backward)


def _at(tree: PyTree, part: jax.Array | int) -> PyTree:
    return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, part, keepdims=False), tree)


def _put(tree: PyTree, new: PyTree, part: jax.Array) -> PyTree:
    def put(whole: jax.Array, each: jax.Array) -> jax.Array:
        return jax.lax.dynamic_update_index_in_dim(whole, each, part, 0)

    return jax.tree.map(put, tree, new)
