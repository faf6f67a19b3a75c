import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.flops import inner_programs
from leapjax.models.linear import linear, rows_times_matrix

KEY = jax.random.key(0)
X = jax.random.normal(KEY, (2, 3, 4, 5))
MATRIX = jax.random.normal(KEY, (5, 6))


def over_batches(product):
    """A loss of nested batches, and its gradients."""

    def loss(x, matrix):
        twice = jax.vmap(jax.vmap(product, (0, None)), (1, None), 1)
        return (jnp.sin(twice(x, matrix)) ** 2).sum()

    return jax.value_and_grad(loss, argnums=(0, 1))


def test_values_and_gradients_are_those_of_a_matrix_product():
    ours, usual = (over_batches(f)(X, MATRIX) for f in (rows_times_matrix, jnp.dot))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), ours, usual)


def test_a_batch_of_matrices_is_a_product_each():
    for axes in ((None, 0), (0, 0)):
        x = X[0, 0] if axes[0] is None else X[0]
        matrices = jnp.stack([MATRIX, 2 * MATRIX, -MATRIX])
        ours = jax.vmap(rows_times_matrix, axes)(x, matrices)
        np.testing.assert_allclose(ours, jnp.matmul(x, matrices), rtol=1e-5)


def contracted(jaxpr):
    """How many axes each matrix product of a program sums over, and the ranks of its operands."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (axes, _), _ = equation.params["dimension_numbers"]
            yield len(axes), *(operand.aval.ndim for operand in equation.invars)
        for inner in inner_programs(list(equation.params.values())):
            yield from contracted(inner)


def test_every_product_is_of_two_matrices():
    jaxpr = jax.make_jaxpr(over_batches(rows_times_matrix))(X, MATRIX).jaxpr
    names = [equation.primitive.name for equation in jaxpr.eqns]
    assert names.count("rows_times_matrix") == 2  # the value, the gradient by the rows
    assert list(contracted(jaxpr)) == [(1, 2, 2)]  # the gradient by the matrix
    usual = jax.make_jaxpr(over_batches(jnp.dot))(X, MATRIX).jaxpr
    assert max(contracted(usual)) == (3, 4, 4)  # what this is here to avoid


def test_the_layer_is_flax_own():
    x = X[0]
    ours = linear(6, nn.initializers.normal(), dtype="bfloat16")
    usual = nn.Dense(6, dtype="bfloat16")
    params = ours.init(KEY, x)
    assert jax.tree.structure(params) == jax.tree.structure(usual.init(KEY, x))
    result = ours.apply(params, x)
    assert result.dtype == jnp.bfloat16
    np.testing.assert_array_equal(result, usual.apply(params, x))
