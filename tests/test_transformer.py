import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.models.transformer import KeysValues, Transformer, causal_mask
from tests.parameters import random_like
from tests.quick import quick_jit

LAYERS, WIDTH, HEADS = 2, 16, 2
PREFIX, TOKENS = 4, 5
MODULE = Transformer(LAYERS, WIDTH, HEADS)


EVERYWHERE = np.arange(TOKENS)
RNG = np.random.default_rng(1)
X = RNG.normal(size=(TOKENS, WIDTH)).astype(np.float32)
FIXED = RNG.normal(size=(PREFIX, WIDTH)).astype(np.float32)
PARAMS = random_like(jax.eval_shape(MODULE.init, jax.random.key(0), X, EVERYWHERE))


@quick_jit
def run(params, x, queried, mask=None):
    return MODULE.apply(params, x, queried, mask=mask)


@quick_jit
def run_with_prefix(params, fixed, x, queried, prefix_mask=None, mask=None):
    memory = MODULE.apply(params, fixed, prefix_mask, method="prefix")
    return MODULE.apply(params, x, queried, memory, mask)


# The oracle: all tokens together, an explicit mask, one head at a time, in float64.


def norm(p, x):
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt(x.var(-1, keepdims=True) + 1e-6) * p["scale"] + p["bias"]


def linear(p, x):
    return x @ np.asarray(p["kernel"], np.float64) + p.get("bias", 0.0)


def gelu(x):
    return 0.5 * x * (1 + np.tanh(np.sqrt(2 / np.pi) * (x + 0.044715 * x**3)))


def oracle(params, x, mask):
    """Outputs at every token, where token i attends to token j if `mask[i, j]`."""
    params = params["params"]
    x = x.astype(np.float64)
    size = WIDTH // HEADS
    for index in range(LAYERS):
        p = params[f"blocks_{index}"]
        h = norm(p["norm_attention"], x)
        queries, keys, values = (linear(p[name], h) for name in ("query", "key", "value"))
        attended = np.zeros_like(x)
        for head in range(HEADS):
            part = slice(head * size, (head + 1) * size)
            for i in range(len(x)):
                seen = np.flatnonzero(mask[i])
                scores = keys[seen, part] @ queries[i, part] / np.sqrt(size)
                weights = np.exp(scores - scores.max())
                attended[i, part] = weights / weights.sum() @ values[seen, part]
        x = x + linear(p["output"], attended)
        h = linear(p["expand"], norm(p["norm_perceptron"], x))
        x = x + linear(p["contract"], gelu(h))
    return norm(params["norm"], x)


def joint_mask(prefix_mask=True, mask=True):
    """The prefix sees itself; the tokens see the prefix and each other: where they may."""
    joint = np.zeros((PREFIX + TOKENS, PREFIX + TOKENS), bool)
    joint[:PREFIX, :PREFIX] = prefix_mask
    joint[PREFIX:] = mask
    return joint


def some_mask(rows, columns):
    """Half of all pairs, and each token itself."""
    own = np.eye(rows, columns, columns - rows, dtype=bool)
    return own | (np.random.default_rng(rows + columns).random((rows, columns)) < 0.4)


ALL = np.ones((PREFIX + TOKENS, PREFIX + TOKENS), bool)
AMONG_PREFIX, OF_TOKENS = some_mask(PREFIX, PREFIX), some_mask(TOKENS, PREFIX + TOKENS)
CLOSE = {"rtol": 1e-4, "atol": 1e-4}
JOINED = np.concatenate([FIXED, X])


def test_bidirectional_attention_equals_the_oracle():
    expected = oracle(PARAMS, X, np.ones((TOKENS, TOKENS), bool))
    np.testing.assert_allclose(run(PARAMS, X, EVERYWHERE), expected, **CLOSE)


def test_attention_under_any_mask_equals_the_oracle():
    mask = some_mask(TOKENS, TOKENS)
    expected = oracle(PARAMS, X, mask)
    np.testing.assert_allclose(run(PARAMS, X, EVERYWHERE, mask), expected, **CLOSE)
    for other in (mask.T, np.ones_like(mask)):  # rows look, columns are looked at
        assert np.abs(oracle(PARAMS, X, other) - expected).max() > 0.05


def test_cached_prefix_equals_running_all_tokens_together():
    actual = run_with_prefix(PARAMS, FIXED, X, EVERYWHERE)
    expected = oracle(PARAMS, JOINED, joint_mask())[PREFIX:]
    np.testing.assert_allclose(actual, expected, **CLOSE)
    # The mask matters: a prefix that saw the tokens would give something else.
    assert np.abs(oracle(PARAMS, JOINED, ALL)[PREFIX:] - expected).max() > 0.01


def test_masked_prefix_equals_running_all_tokens_together():
    actual = run_with_prefix(PARAMS, FIXED, X, EVERYWHERE, AMONG_PREFIX, OF_TOKENS)
    expected = oracle(PARAMS, JOINED, joint_mask(AMONG_PREFIX, OF_TOKENS))[PREFIX:]
    np.testing.assert_allclose(actual, expected, **CLOSE)
    # Each of the two masks matters.
    for other in (joint_mask(mask=OF_TOKENS), joint_mask(AMONG_PREFIX)):
        assert np.abs(oracle(PARAMS, JOINED, other)[PREFIX:] - expected).max() > 0.05


HIDDEN = np.array([False, True, False, True])  # of the prefix, to all


def hiding(hidden):
    """The two masks that let nobody see some tokens of the prefix."""
    return np.tile(~hidden, (PREFIX, 1)), np.tile(np.append(~hidden, [True] * TOKENS), (TOKENS, 1))


def test_masked_prefix_tokens_change_nothing():
    changed = FIXED + np.where(HIDDEN, 3.0, 0.0)[:, None].astype(np.float32)
    before = run_with_prefix(PARAMS, FIXED, X, EVERYWHERE, *hiding(HIDDEN))
    after = run_with_prefix(PARAMS, changed, X, EVERYWHERE, *hiding(HIDDEN))
    np.testing.assert_array_equal(after, before)
    changed[0] += RNG.normal(size=WIDTH)
    after = run_with_prefix(PARAMS, changed, X, EVERYWHERE, *hiding(HIDDEN))
    assert np.abs(after - before).max() > 0.05


def test_a_prefix_that_is_masked_everywhere_is_no_prefix():
    actual = run_with_prefix(PARAMS, FIXED, X, EVERYWHERE, *hiding(np.ones(PREFIX, bool)))
    np.testing.assert_allclose(actual, run(PARAMS, X, EVERYWHERE), **CLOSE)


@pytest.mark.parametrize("prefix", [0, PREFIX])
def test_a_causal_mask_hides_later_tokens(prefix):
    mask = np.asarray(causal_mask(TOKENS, prefix))
    assert mask.dtype == bool
    expected = [[j < prefix or j - prefix <= i for j in range(prefix + TOKENS)] for i in EVERYWHERE]
    np.testing.assert_array_equal(mask, expected)

    def outputs(x):
        if prefix:
            everything = np.ones((PREFIX, PREFIX), bool)
            return run_with_prefix(PARAMS, FIXED, x, EVERYWHERE, everything, mask)
        return run(PARAMS, x, EVERYWHERE, mask)

    before = outputs(X)
    for token in range(TOKENS):
        changed = X.copy()
        changed[token] += RNG.normal(size=WIDTH)
        difference = np.abs(outputs(changed) - before).max(axis=1)
        np.testing.assert_array_equal(difference[:token], 0)
        assert (difference[token:] > 0.01).all()


@pytest.mark.parametrize("queried", [[2], [4, 0], [3, 3, 1]])
def test_last_layer_at_queried_positions_is_the_full_output_there(queried):
    queried = np.array(queried)

    def masked(queried):
        return run_with_prefix(PARAMS, FIXED, X, queried, AMONG_PREFIX, OF_TOKENS)

    for outputs in (functools.partial(run, PARAMS, X), masked):
        np.testing.assert_allclose(
            outputs(queried), outputs(EVERYWHERE)[queried], rtol=1e-5, atol=1e-5
        )


def test_attention_without_positions_is_equivariant_to_order():
    order = np.array([3, 0, 4, 1, 2])
    np.testing.assert_allclose(
        run(PARAMS, X[order], EVERYWHERE), run(PARAMS, X, EVERYWHERE)[order], **CLOSE
    )


def test_prefix_holds_keys_and_values_of_every_layer():
    memory = jax.eval_shape(lambda p, x: MODULE.apply(p, x, method="prefix"), PARAMS, FIXED)
    shape = (PREFIX, HEADS, WIDTH // HEADS)
    assert [(type(m), m.keys.shape, m.values.shape) for m in memory] == [
        (KeysValues, shape, shape)
    ] * LAYERS


def test_dropout_is_random_in_training_only():
    module = Transformer(LAYERS, WIDTH, HEADS, dropout=0.5)

    @quick_jit
    def train(key):
        return module.apply(PARAMS, X, EVERYWHERE, deterministic=False, rngs={"dropout": key})

    first, second = train(jax.random.key(0)), train(jax.random.key(1))
    np.testing.assert_array_equal(train(jax.random.key(0)), first)
    assert np.abs(first - second).max() > 0.05
    plain = quick_jit(lambda x: module.apply(PARAMS, x, EVERYWHERE))(jnp.asarray(X))
    np.testing.assert_allclose(plain, run(PARAMS, X, EVERYWHERE), rtol=1e-6, atol=1e-6)
