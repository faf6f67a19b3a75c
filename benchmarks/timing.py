"""How long something takes, and how long it could take at best on this machine."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax


def fastest(run: Callable[[], Any], seconds: float) -> float:
    """The shortest of several runs, in seconds."""
    best, spent = float("inf"), 0.0
    while spent < seconds:
        begun = time.perf_counter()
        jax.block_until_ready(run())
        taken = time.perf_counter() - begun
        best, spent = min(best, taken), spent + taken
    return best


def matmul_peak(tokens: int, width: int, seconds: float) -> float:
    """GFLOP/s of a perceptron's two matrix products, one after the other, and no more.

    Of `[tokens, width]` by `[width, 4 width]` and back, as the transformers here have them,
    with all cores on one product at a time.
    """
    x = jax.random.normal(jax.random.key(0), (tokens, width))
    expand = jax.random.normal(jax.random.key(1), (width, 4 * width)) / width
    contract = jax.random.normal(jax.random.key(2), (4 * width, width)) / width
    flops = 2 * 2 * tokens * width * 4 * width
    repeats = max(1, int(2e9 / flops))  # hides the dispatch

    @jax.jit
    def multiply(x: jax.Array, expand: jax.Array, contract: jax.Array) -> jax.Array:
        # Each product needs the one before, so none can be left out.
        return jax.lax.fori_loop(0, repeats, lambda _, y: (y @ expand) @ contract, x)

    jax.block_until_ready(multiply(x, expand, contract))
    return repeats * flops / fastest(partial(multiply, x, expand, contract), seconds / 4) / 1e9
