"""Which positions of a plan come next: small functions, and their names in configurations."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.errors import UserError

Select = Callable[[jax.Array, jax.Array], jax.Array]
# (energies [T, A] of every action, key) -> ranks [T]. Rows of filled positions hold energies of
# another position, so a rank depends on its own row only.


def most_certain(energies: jax.Array, key: jax.Array) -> jax.Array:
    """Ranks positions by the probability of their likeliest action (MaskGIT, Chang et al., 2022).

    Args:
        energies: energies `[T, A]` of every action at every position.
        key: unused.

    Returns:
        Ranks `[T]`: the position of the highest rank comes first.
    """
    del key
    return compute_probabilities(energies).max(axis=-1)


def by_margin(energies: jax.Array, key: jax.Array) -> jax.Array:
    """Ranks positions by the lead of their likeliest action over the second.

    The source is Kim et al., 2025 (arXiv 2502.06768). It takes and returns the same as
    `most_certain`.
    """
    del key
    likeliest = jax.lax.top_k(compute_probabilities(energies), min(2, energies.shape[-1]))[0]
    return likeliest[:, 0] - likeliest[:, -1]


def left_to_right(energies: jax.Array, key: jax.Array) -> jax.Array:
    """Ranks positions from left to right; takes and returns the same as `most_certain`."""
    del key
    return -jnp.arange(energies.shape[0], dtype=jnp.float32)


def in_random_order(energies: jax.Array, key: jax.Array) -> jax.Array:
    """Ranks positions at random; a key always gives one order.

    It takes and returns the same as `most_certain`.
    """
    return jax.random.uniform(key, energies.shape[:1])


SELECTIONS: Mapping[str, Select] = {
    "confident": most_certain,
    "margin": by_margin,
    "sequential": left_to_right,
    "random": in_random_order,
}


class Commitment(NamedTuple):
    """How many open positions a pass fills: as many as are certain, and at least a fixed number.

    Attributes:
        least: number of positions that every pass fills, while so many are open.
        certainty: a pass also fills each next position whose likeliest action has at least this
            probability; 1: no further position.
        entropy: a pass also fills each next position, as long as their entropies without the
            largest add up to at most this, in nats (EB-Sampler, Ben-Hamu et al., arXiv 2505.24857).
            It bounds the dependence between actions that a pass chooses independently.
    """

    least: int = 1
    certainty: float = 1.0
    entropy: float = 0.0

    @property
    def adapts(self) -> bool:
        """Whether the number of positions depends on the energies."""
        return self.certainty < 1 or self.entropy > 0


def choose_open(
    energies: jax.Array, open_: jax.Array, ranks: jax.Array, commitment: Commitment
) -> tuple[jax.Array, jax.Array]:
    """Chooses the open positions that a pass fills.

    Args:
        energies: energies `[T, A]` of every action; rows of filled positions are ignored.
        open_: booleans `[T]`: whether a position is open.
        ranks: ranks `[T]` from a `Select`.
        commitment: how many positions to fill.

    Returns:
        Positions `[P]`, the highest rank first, and booleans `[P]`: whether each is filled. P is
        `commitment.least`, or T where the number depends on the energies.

    Raises:
        UserError: the ranks have another shape.
    """
    count = open_.shape[0] if commitment.adapts else commitment.least
    # A rank of a user's own may be NaN or -inf, and the position is open all the same.
    lowest = jnp.finfo(jnp.float32).min
    if jnp.shape(ranks) != open_.shape:
        raise UserError(
            f"fill must return a rank for each position, {list(open_.shape)}, got "
            f"{list(jnp.shape(ranks))}"
        )
    ranks = jnp.nan_to_num(jnp.asarray(ranks, jnp.float32), nan=lowest, neginf=lowest)
    where = jax.lax.top_k(jnp.where(open_, ranks, -jnp.inf), count)[1]
    chosen = jnp.arange(count) < commitment.least
    if commitment.adapts:
        probabilities = compute_probabilities(energies[where])
        entropies = jax.scipy.special.entr(probabilities).sum(axis=-1)
        spread = jnp.cumsum(entropies) - jax.lax.cummax(entropies)
        certain = probabilities.max(axis=-1) >= commitment.certainty
        chosen |= (jnp.cumsum(~certain) == 0) & (commitment.certainty < 1)
        chosen |= (spread <= commitment.entropy) & (commitment.entropy > 0)
    return where, chosen & open_[where]


def compute_probabilities(energies: jax.Array) -> jax.Array:
    """Returns the probabilities `[P, A]` of actions; 0 where all of a row are forbidden."""
    return jnp.nan_to_num(jax.nn.softmax(-energies, axis=-1))
