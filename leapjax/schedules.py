"""Chooses which actions of a window are masked in training."""

import jax
import jax.numpy as jnp

from leapjax.checks import check_integer

MASKINGS = ("one", "each", "all", "random", "stratified")
SINGLE = ("one", "each")  # they mask a single action in each copy


def sample_masks(key: jax.Array, horizon: int, masking: str) -> jax.Array:
    """Samples which actions of a window to mask: `[copies, T]` bool, at least one in each copy.

    - `one`: one random position (paper, appendix "Experiment details"); 1 copy.
    - `each`: every position in turn, T copies (what the authors' code does).
    - `all`: every position, so that actions are predicted from the state alone (the authors'
      code, in PickUpLoc); 1 copy.
    - `random`: n random positions, n uniform in 1 .. T, so that training includes the all-masked
      start of planning; 1 copy.
    - `stratified`: as `random`, with n = 1, 2, .. T in T copies, so that every window trains the
      all-masked start. For encoders that cost much more than a pass over T actions.

    Args:
        key: random key.
        horizon: T.
        masking: a name of the list above.

    Raises:
        ValueError: the horizon is not a positive integer, or the masking is unknown.
    """
    horizon = check_integer("horizon", horizon, 1)
    if masking == "each":
        return jnp.eye(horizon, dtype=bool)
    if masking == "all":
        return jnp.ones((1, horizon), dtype=bool)
    count_key, order_key = jax.random.split(key)
    rank = jax.random.permutation(order_key, horizon)
    if masking == "one":
        return (rank == 0)[None]
    if masking == "stratified":
        orders = jax.vmap(jax.random.permutation, in_axes=(0, None))
        ranks = orders(jax.random.split(order_key, horizon), horizon)  # [T, T]
        return ranks <= jnp.arange(horizon)[:, None]
    if masking == "random":
        return (rank < jax.random.randint(count_key, (), 1, horizon + 1))[None]
    raise ValueError(f"unknown masking {masking!r}: expected one of {', '.join(MASKINGS)}")
