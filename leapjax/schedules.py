"""Which actions of a window are masked in training: a small pure schedule."""

import jax
import jax.numpy as jnp

from leapjax.checks import check_integer

MASKINGS = ("one", "each", "all", "random", "stratified")
SINGLE = ("one", "each")  # those that mask one action in every copy


def sample_masks(key: jax.Array, horizon: int, masking: str) -> jax.Array:
    """Which actions of one window to mask: booleans `[copies, T]`, never all False.

    - `one`: one random position (paper, appendix "Experiment details"); 1 copy.
    - `each`: every position in turn, T copies (what the authors' code does).
    - `all`: every position, so that the state alone says what to do (the authors' code, in
      PickUpLoc); 1 copy.
    - `random`: n positions with n uniform in 1 .. T, so that the all-masked start of
      planning is an input that training has seen; 1 copy.
    - `stratified`: the same with n = 1, 2, .. T, T copies: every window is also learned from as
      planning starts. For encoders that cost much more than a pass over T actions.
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
