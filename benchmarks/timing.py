"""Times calls, and measures this machine's matrix-multiply peak."""

import functools
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding

from leapjax import files, sharding
from leapjax.running import results

Row = dict[str, Any]  # one measurement, as JSON values


def fastest(run: Callable[[], Any], seconds: float) -> float:
    """Returns the seconds of the fastest call; repeats calls for at least `seconds`."""
    best, spent = float("inf"), 0.0
    while spent < seconds or best == float("inf"):
        begun = time.perf_counter()
        jax.block_until_ready(run())
        taken = time.perf_counter() - begun
        best, spent = min(best, taken), spent + taken
    return best


def matmul_peak(tokens: int, width: int, seconds: float) -> float:
    """Measures the GFLOP/s of one transformer layer's matrix products, one after the other.

    Four products of `[tokens, width]` by `[width, width]`, then one to `4 width` and one back.
    Returns the better of two ways: all cores on one product, or the tokens split over devices.
    """
    devices = len(jax.local_devices())
    tokens = -(-tokens // devices) * devices  # splits evenly over devices
    key = jax.random.key(0)
    x = jax.random.normal(key, (tokens, width))
    shapes = [(width, width)] * 4 + [(width, 4 * width), (4 * width, width)]
    weights = [jax.random.normal(key, shape) / width for shape in shapes]
    flops = 2 * tokens * sum(rows * columns for rows, columns in shapes)
    repeats = max(1, int(2e9 / flops))  # makes the cost of dispatch negligible

    def multiply(_: None, weights: list[jax.Array], x: jax.Array) -> jax.Array:
        # Each product needs the last one, so XLA cannot leave it out.
        def layer(_: int, y: jax.Array) -> jax.Array:
            return functools.reduce(jnp.matmul, weights, y)

        return jax.lax.fori_loop(0, repeats, layer, x)

    best = float("inf")
    for mesh in {sharding.make_mesh(1), sharding.make_mesh(tokens)}:
        run = partial(
            sharding.split_batches(multiply, mesh), None, sharding.replicate(weights, mesh),
            jax.device_put(x, NamedSharding(mesh, sharding.SPLIT)),
        )  # fmt: skip
        jax.block_until_ready(run())
        best = min(best, fastest(run, seconds / 4))
    return repeats * flops / best / 1e9


def check_writable(*paths: Path | None) -> None:
    """Checks, before any measurement, that files can be written.

    Raises:
        UserError: names the folder that cannot be written to.
    """
    for path in paths:
        if path is not None:
            files.check_writable(path.parent)


def write_rows(path: Path | None, rows: Sequence[Row]) -> None:
    """Writes rows as JSON, each with the date and versions."""
    if path is not None:
        made = {"date": results.format_date(), "versions": results.find_versions()}
        files.write_text(path, json.dumps([{**row, **made} for row in rows], indent=1) + "\n")
