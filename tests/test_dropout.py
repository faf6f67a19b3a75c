import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.models.dropout import Dropout

X = jnp.ones((50, 7, 31))  # of an odd size: the last word is half used


def dropped(rate, x=X, seed=0):
    return np.asarray(Dropout(rate).apply({}, x, False, rngs={"dropout": jax.random.key(seed)}))


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.9])
def test_a_share_is_zero_and_the_mean_stays(rate):
    out = dropped(rate, jnp.ones((1000, 101)))
    deviation = (rate * (1 - rate) / out.size) ** 0.5
    assert abs((out == 0).mean() - rate) < 5 * deviation
    np.testing.assert_allclose(out[out != 0], 1 / (1 - rate), rtol=1e-3)


def test_every_number_is_decided_alone():
    """Halves of a word, rows and examples of a batch say nothing of each other."""
    keys = jax.random.split(jax.random.key(1), 64)
    module = Dropout(0.5)
    draw = jax.vmap(lambda key: module.apply({}, jnp.ones((64, 9)), False, rngs={"dropout": key}))
    kept = np.asarray(draw(keys) > 0).reshape(64, -1) * 2.0 - 1
    flat = kept.reshape(-1)
    for other in (*(np.roll(flat, n) for n in (1, 2, 9)), np.roll(kept, 1, 0).ravel()):
        assert abs((flat * other).mean()) < 5 / flat.size**0.5


def test_the_gradient_passes_where_the_number_was_kept():
    key = jax.random.key(2)
    out, gradient = jax.value_and_grad(
        lambda x: Dropout(0.3).apply({}, x, False, rngs={"dropout": key}).sum()
    )(X)
    np.testing.assert_array_equal(gradient, dropped(0.3, seed=2))
    np.testing.assert_allclose(out, gradient.sum(), rtol=1e-5)


def test_without_a_rate_or_deterministic_it_is_the_identity_and_asks_for_no_key():
    np.testing.assert_array_equal(Dropout(0.0).apply({}, X, False), X)
    np.testing.assert_array_equal(Dropout(0.3).apply({}, X, True), X)


def test_lower_precision_stays():
    assert dropped(0.1, X.astype(jnp.bfloat16)).dtype == jnp.bfloat16
