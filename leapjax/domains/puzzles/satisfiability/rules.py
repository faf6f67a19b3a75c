"""The clauses of a formula as a hand-written energy: no training."""

import jax
import jax.numpy as jnp

from leapjax.domains.puzzles.satisfiability.formulas import Formula, find_violated
from leapjax.types import Context, Energy, Params


def rules(differ: bool, weight: float = 4.0) -> Energy:
    """Makes the energy of a plan for a formula: `weight` for each violated clause.

    Position 0 of a plan is the next variable. The energy accepts MASK: a clause with an open
    literal is not violated. It is infinite if a plan ends. Its parameters are `()`.

    Args:
        differ: whether each clause also needs a false literal.
        weight: of a violated clause, in nats.
    """
    end, mask = 2, 3

    def encode(params: Params, context: Context) -> Formula:
        del params
        return jax.tree.map(jnp.asarray, context.observation)

    def weigh(formula: Formula, actions: jax.Array) -> jax.Array:
        """Weighs the clauses that a plan violates; positions after the last variable are free."""
        places = formula.variable + jnp.arange(actions.shape[0])
        values = formula.values.at[places].set(actions, mode="drop")
        return weight * find_violated(formula.literals, values, differ).sum()

    def conditional(
        params: Params, formula: Formula, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        del params
        masked = actions.at[positions].set(mask)

        def score(position: jax.Array) -> jax.Array:
            values = [weigh(formula, masked.at[position].set(value)) for value in (0, 1)]
            return jnp.stack([*values, jnp.inf])

        return jax.vmap(score)(positions)

    def total(params: Params, formula: Formula, actions: jax.Array) -> jax.Array:
        del params
        return jnp.where(jnp.any(actions == end), jnp.inf, weigh(formula, actions))

    return Energy(encode, conditional, total, end + 1)
