"""Sudoku's rules as a hand-written energy: no training."""

import jax
import jax.numpy as jnp

from leapjax.sudoku import boards
from leapjax.types import Context, Energy, Params


def rules(side: int, weight: float = 4.0) -> Energy:
    """The energy of a filled board: `weight` for each pair of cells that break a rule.

    It accepts MASK: a cell that is not filled breaks none. A clue cannot be changed, and the end
    action never chosen. Parameters: none, `()`.

    Args:
        side: of the board.
        weight: of a broken rule, in nats.
    """
    peers, end = jnp.asarray(boards.peers(side), jnp.float32), side

    def encode(params: Params, context: Context) -> jax.Array:
        del params
        return context.observation.digits  # [cells], 0 where a digit is wanted

    def known(clues: jax.Array, actions: jax.Array) -> jax.Array:
        """Which digit is where, clues included: `[cells, side]`, all 0 where none is."""
        return jax.nn.one_hot(jnp.where(clues > 0, clues - 1, actions), side)

    def conditional(
        params: Params, clues: jax.Array, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        del params
        tokens = actions.at[positions].set(side + 1)
        broken = peers[positions] @ known(clues, tokens)  # [P, side]
        clue = clues[positions][:, None]
        other = (clue > 0) & (clue - 1 != jnp.arange(side))
        energies = jnp.where(other, jnp.inf, weight * broken)
        return jnp.concatenate([energies, jnp.full((positions.shape[0], 1), jnp.inf)], axis=1)

    def total(params: Params, clues: jax.Array, actions: jax.Array) -> jax.Array:
        del params
        digits = known(jnp.zeros_like(clues), actions)
        pairs = jnp.einsum("ad,ab,bd->", digits, peers, digits) / 2
        changed = jnp.any((clues > 0) & (clues - 1 != actions)) | jnp.any(actions >= end)
        return jnp.where(changed, jnp.inf, weight * pairs)

    return Energy(encode, conditional, total, side + 1)
