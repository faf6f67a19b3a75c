"""Sudoku's rules as a hand-written energy: no training."""

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.domains.puzzles.sudoku import boards
from leapjax.types import Context, Energy, Params


def rules(side: int, weight: float = 4.0) -> Energy:
    """Makes the energy of a plan on a board: `weight` for each pair of cells that break a rule.

    Position 0 of a plan is the next cell to write. The energy accepts MASK: an empty cell
    breaks no rule. It is infinite if a plan changes a clue or ends. Its parameters are `()`.

    Args:
        side: of the board.
        weight: of a broken rule, in nats.
    """
    # NumPy's array: JAX's would start the devices before a program has chosen them.
    peers, cells, end = np.asarray(boards.find_peers(side), np.float32), side**2, side
    mask = side + 1

    def encode(params: Params, context: Context) -> tuple[jax.Array, jax.Array]:
        del params
        board = context.observation
        return jnp.asarray(board.digits), jnp.asarray(board.cell)  # [cells], 0 if open; the next

    def known(digits: jax.Array, cell: jax.Array, actions: jax.Array) -> jax.Array:
        """One-hot digits of a board that a plan continues: `[cells, side]`, 0 for empty cells."""
        places = cell + jnp.arange(actions.shape[0])
        planned = jnp.full(cells, mask).at[places].set(actions, mode="drop")
        return jax.nn.one_hot(jnp.where(digits > 0, digits - 1, planned), side)

    def conditional(
        params: Params,
        board: tuple[jax.Array, jax.Array],
        actions: jax.Array,
        positions: jax.Array,
    ) -> jax.Array:
        del params
        digits, cell = board
        tokens = actions.at[positions].set(mask)
        # Positions after the last cell write no digit and break no rule.
        on_board = (cell + positions < cells)[:, None]
        places = jnp.minimum(cell + positions, cells - 1)
        broken = jnp.asarray(peers)[places] @ known(digits, cell, tokens)  # [P, side]
        clue = digits[places][:, None]
        other = (clue > 0) & (clue - 1 != jnp.arange(side))
        energies = jnp.where(on_board, jnp.where(other, jnp.inf, weight * broken), 0.0)
        return jnp.concatenate([energies, jnp.full((positions.shape[0], 1), jnp.inf)], axis=1)

    def total(params: Params, board: tuple[jax.Array, jax.Array], actions: jax.Array) -> jax.Array:
        del params
        digits, cell = board
        filled = known(digits, cell, actions)
        pairs = jnp.einsum("ad,ab,bd->", filled, peers, filled) / 2
        places = cell + jnp.arange(actions.shape[0])
        clues = jnp.where(places < cells, digits[jnp.minimum(places, cells - 1)], 0)
        changed = jnp.any((clues > 0) & (clues - 1 != actions)) | jnp.any(actions >= end)
        return jnp.where(changed, jnp.inf, weight * pairs)

    return Energy(encode, conditional, total, side + 1)
