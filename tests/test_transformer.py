import jax
import jax.numpy as jnp
import numpy as np

from leapjax.models.transformer import Transformer
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
    """Computes all outputs; token i attends to j if `mask[i, j]` or `mask[head, i, j]`."""
    params, mask = params["params"], np.broadcast_to(mask, (HEADS, len(x), len(x)))
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
                visible = np.flatnonzero(mask[head, i])
                scores = keys[visible, part] @ queries[i, part] / np.sqrt(size)
                weights = np.exp(scores - scores.max())
                attended[i, part] = weights / weights.sum() @ values[visible, part]
        x = x + linear(p["output"], attended)
        h = linear(p["expand"], norm(p["norm_perceptron"], x))
        x = x + linear(p["contract"], gelu(h))
    return norm(params["norm"], x)


def joint_mask(prefix_mask=True, mask=True):
    """Joins the mask of the prefix, which sees only itself, with the mask of the tokens."""
    joint = np.zeros((PREFIX + TOKENS, PREFIX + TOKENS), bool)
    joint[:PREFIX, :PREFIX] = prefix_mask
    joint[PREFIX:] = mask
    return joint


def random_mask(rows, columns):
    """Draws a mask with about half of all pairs; each token sees itself."""
    own = np.eye(rows, columns, columns - rows, dtype=bool)
    return own | (np.random.default_rng(rows + columns).random((rows, columns)) < 0.4)


PREFIX_MASK, TOKEN_MASK = random_mask(PREFIX, PREFIX), random_mask(TOKENS, PREFIX + TOKENS)
CLOSE = {"rtol": 1e-4, "atol": 1e-4}
JOINED = np.concatenate([FIXED, X])


def test_attention_equals_the_oracle():
    mask = random_mask(TOKENS, TOKENS)
    head_masks = np.stack([mask.T, mask])
    for argument, visible in ((None, np.ones_like(mask)), (head_masks, head_masks), (mask, mask)):
        expected = oracle(PARAMS, X, visible)
        np.testing.assert_allclose(run(PARAMS, X, EVERYWHERE, argument), expected, **CLOSE)
    for other in (mask.T, np.ones_like(mask)):  # rows are queries, columns are keys
        assert np.abs(oracle(PARAMS, X, other) - expected).max() > 0.05


def test_a_cached_prefix_equals_running_all_tokens_together():
    for masks in ((), (PREFIX_MASK, TOKEN_MASK)):
        actual = run_with_prefix(PARAMS, FIXED, X, EVERYWHERE, *masks)
        expected = oracle(PARAMS, JOINED, joint_mask(*masks))[PREFIX:]
        np.testing.assert_allclose(actual, expected, **CLOSE)
    # Both masks matter.
    for other in (joint_mask(mask=TOKEN_MASK), joint_mask(PREFIX_MASK)):
        assert np.abs(oracle(PARAMS, JOINED, other)[PREFIX:] - expected).max() > 0.05


def test_outputs_at_queried_positions_equal_the_full_outputs():
    queried = np.array([3, 3, 0])

    def outputs(queried):
        return run_with_prefix(PARAMS, FIXED, X, queried, PREFIX_MASK, TOKEN_MASK)

    np.testing.assert_allclose(outputs(queried), outputs(EVERYWHERE)[queried], rtol=1e-5, atol=1e-5)


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
