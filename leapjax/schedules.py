"""Small pure schedules: the sampling temperature over iterations, which actions to mask."""

import jax
import jax.numpy as jnp

MASKINGS = ("one", "each", "random")


def linear_temperatures(first: float, last: float, iterations: int) -> jax.Array:
    """Temperatures `[iterations]` going linearly from `first` to `last`.

    Raises:
        ValueError: a negative or non-finite temperature, or no iteration.
    """
    if iterations < 1:
        raise ValueError(f"iterations must be at least 1, got {iterations}")
    check_temperatures(first, last)
    return jnp.linspace(first, last, iterations, dtype=jnp.float32)


def check_temperatures(*temperatures: float) -> None:
    """Refuses, with `ValueError`, what is negative or not finite."""
    for value in temperatures:
        if not 0 <= value < float("inf"):
            raise ValueError(f"a temperature must be finite and at least 0, got {value}")


def sample_masks(key: jax.Array, horizon: int, masking: str) -> jax.Array:
    """Which actions of one window to mask: booleans `[copies, T]`, never all False.

    - `one`: one random position (paper, appendix "Experiment details"); 1 copy.
    - `each`: every position in turn, T copies (what the authors' code does).
    - `random`: n positions with n uniform in 1 .. T, so that the all-masked start of
      planning is an input that training has seen; 1 copy.
    """
    if masking == "each":
        return jnp.eye(horizon, dtype=bool)
    count_key, order_key = jax.random.split(key)
    rank = jax.random.permutation(order_key, horizon)
    if masking == "one":
        return (rank == 0)[None]
    if masking == "random":
        return (rank < jax.random.randint(count_key, (), 1, horizon + 1))[None]
    raise ValueError(f"unknown masking {masking!r}: expected one of {', '.join(MASKINGS)}")
