"""States that stay the same for some steps are computed once.

How many differ depends on the data, and shapes may not: results have room for all of them, and a
loop ends where they do. JAX differentiates no loop of unknown length, so its gradient is here.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.types import PyTree


class Runs(NamedTuple):
    """Runs of equal things in B sequences of n."""

    first: jax.Array  # [B * n] int32: of each run its first, an index into all B * n; then zeros
    total: jax.Array  # [] int32: how many runs there are
    which: jax.Array  # [B, n] int32: the run that each is of


def runs(sequences: PyTree) -> Runs:
    """Of things with leaves `[B, n, ...]`, n > 0: one ends where the next thing is another."""

    def changed(leaf: jax.Array) -> jax.Array:
        return jnp.any(leaf[:, 1:] != leaf[:, :-1], axis=range(2, leaf.ndim))

    differ = jax.tree.reduce(jnp.logical_or, jax.tree.map(changed, sequences))  # [B, n - 1]
    new = jnp.pad(differ, ((0, 0), (1, 0)), constant_values=True)
    first = jnp.nonzero(new.reshape(-1), size=new.size)[0].astype(jnp.int32)
    return Runs(first, jnp.sum(new), (jnp.cumsum(new) - 1).reshape(new.shape))


def of_first(
    function: Callable[[PyTree, PyTree], jax.Array],
    things: PyTree,
    rows: PyTree,
    count: jax.Array,
    size: int,
) -> jax.Array:
    """`function(thing, row)` of the first `count` of N: `[N, ...]`; beyond them anything.

    Args:
        function: of one; it may capture arrays of floating-point numbers, such as parameters.
        things: leaves `[N, ...]` of any type, by which no gradient is taken.
        rows: floating-point numbers `[N, ...]`.
        count: `[]` int32, in 0 .. N.
        size: as many are taken at a time; so some beyond `count` are, and must be finite. The
            gradient computes them again: to store what it takes costs more, and room for N.
    """
    total = jax.tree.leaves(things)[0].shape[0]

    def in_parts(x: jax.Array) -> jax.Array:
        """`[P, size, ...]`: so that all are of one size, the first of all fills the last part."""
        x = jnp.concatenate([x, x[:1].repeat(-total % size, axis=0)])
        return x.reshape(-1, size, *x.shape[1:])

    things, rows = jax.tree.map(in_parts, (things, rows))
    each, captured = jax.closure_convert(jax.vmap(function), *_at((things, rows), 0))
    found = _of_parts(each, things, (count + size - 1) // size, rows, captured)
    return found.reshape(-1, *found.shape[2:])[:total]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _of_parts(
    each: Callable[..., jax.Array], things: PyTree, count: jax.Array, rows: PyTree, captured: list
) -> jax.Array:
    """`each` of the first `count []` of P parts, `[P, ...]`; then zeros."""

    def step(part: jax.Array, found: jax.Array) -> jax.Array:
        return _put(found, each(*_at((things, rows), part), *captured), part)

    one = jax.eval_shape(each, *_at((things, rows), 0), *captured)
    parts = jax.tree.leaves(things)[0].shape[0]
    return jax.lax.fori_loop(0, count, step, jnp.zeros((parts, *one.shape), one.dtype))


def _forward(
    each: Callable[..., jax.Array], *given: PyTree
) -> tuple[jax.Array, tuple[PyTree, ...]]:
    return _of_parts(each, *given), given


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


_of_parts.defvjp(_forward, _backward)


def _at(tree: PyTree, part: jax.Array | int) -> PyTree:
    return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, part, keepdims=False), tree)


def _put(tree: PyTree, new: PyTree, part: jax.Array) -> PyTree:
    def put(whole: jax.Array, each: jax.Array) -> jax.Array:
        return jax.lax.dynamic_update_index_in_dim(whole, each, part, 0)

    return jax.tree.map(put, tree, new)
