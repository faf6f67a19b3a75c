"""Linear layers whose gradients stay as fast as their values under `vmap`.

A layer written for `[tokens, D]` and vmapped over examples has a gradient by its weights that
sums over examples and tokens at once. XLA's CPU compiler then transposes whole activations
first (it folds a transposition into a matrix product of two axes only), which takes longer than
the product. Here a batch becomes rows before anything is differentiated, so that every product,
gradients included, is one of two matrices.

This is the only module that imports from `jax.extend` and `jax.interpreters`, which may change
with every release of JAX. Its public functions do not suffice. A `custom_vmap` whose rule calls it
again, which batches of batches need, has no reverse-mode gradient. `custom_vjp` computes the
gradient of each example before it adds them up.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype, Initializer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_rows_p = Primitive("rows_times_matrix")


def rows_times_matrix(rows: jax.Array, matrix: jax.Array) -> jax.Array:
    """`[rows, D]` times `[D, E]`: `[rows, E]`; what is vmapped over `rows` is more rows."""
    return _rows_p.bind(rows, matrix)


def linear(
    features: int,
    kernel_init: Initializer,
    use_bias: bool = True,
    name: str | None = None,
    dtype: Dtype | None = None,
) -> nn.Dense:
    """`nn.Dense` with that product."""
    return nn.Dense(
        features, use_bias, dtype=dtype, kernel_init=kernel_init, name=name, dot_general=_product
    )


def _product(inputs: jax.Array, kernel: jax.Array, *_: Any, **__: Any) -> jax.Array:
    """What `nn.Dense` asks of `lax.dot_general`: the last axis times the kernel's first."""
    rows = inputs.reshape(-1, inputs.shape[-1])
    return rows_times_matrix(rows, kernel).reshape(*inputs.shape[:-1], -1)


def _batch(
    arguments: tuple[jax.Array, jax.Array], axes: tuple[int | None, int | None]
) -> tuple[jax.Array, int]:
    rows, matrix = (
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arguments, axes, strict=True)
    )
    if axes[1] is not None:  # a matrix for each: no longer one product
        return jnp.matmul(rows, matrix), 0
    return _product(rows, matrix), 0


_rows_p.def_impl(jnp.dot)
_rows_p.def_abstract_eval(
    lambda rows, matrix: jax.core.ShapedArray((rows.shape[0], matrix.shape[1]), rows.dtype)
)
mlir.register_lowering(_rows_p, mlir.lower_fun(jnp.dot, multiple_results=False))
batching.primitive_batchers[_rows_p] = _batch
ad.defbilinear(
    _rows_p,
    lambda gradient, rows, matrix: rows_times_matrix(gradient, matrix.T),
    lambda gradient, rows, matrix: jnp.dot(gradient.T, rows).T,
)
