"""Evaluates an energy: with checks, at open positions, and for many plans in little memory."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from leapjax.checks import check_floats, check_kind
from leapjax.types import Energy, Params, PyTree, mask_token, no_violation

SCORED_TOGETHER = 8  # totals of one context at a time: each may hold T copies of a plan


def is_undefined(energies: jax.Array) -> jax.Array:
    """Tells where an energy is NaN or -inf: neither can be compared with others."""
    return jnp.isnan(energies) | jnp.isneginf(energies)


def guard_shapes(energy: Energy) -> Energy:
    """Returns an energy that checks the shapes and types of its results.

    Raises:
        UserError: the argument is not an `Energy`.
    """
    check_kind(energy, Energy)

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        energies = energy.conditional(params, memory, actions, positions)
        return check_floats(
            "conditional of the energy", energies, (positions.shape[0], energy.num_actions)
        )

    def total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        found = energy.total(params, memory, actions)
        return check_floats("total of the energy", found, ())

    def violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        found = energy.violation(params, memory, actions)
        return check_floats("violation of the energy", found, ())

    return energy._replace(
        conditional=conditional,
        total=total,
        violation=no_violation if energy.violation is no_violation else violation,
    )


def check_constraints(
    energy: Energy, params: Params, memory: PyTree, plan: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns whether a plan `[T]` satisfies all constraints, and whether that is defined."""
    violation = energy.violation(params, memory, plan)
    return violation <= 0, ~jnp.isnan(violation)


def score_open(energy: Energy, params: Params, memory: PyTree, plan: jax.Array) -> jax.Array:
    """Returns the energies `[T, A]` of every action at the open positions, in one pass.

    A query masks its position, so an open position takes the place of each filled one. Ignore
    the rows of filled positions.
    """
    open_ = plan == mask_token(energy.num_actions)
    return energy.conditional(
        params, memory, plan, jnp.where(open_, jnp.arange(plan.shape[0]), jnp.argmax(open_))
    )


def compute_totals(energy: Energy, params: Params, memory: PyTree, plans: jax.Array) -> jax.Array:
    """Returns the total energies `[C]` of plans `[C, T]`."""
    return map_few(lambda plan: energy.total(params, memory, plan), plans)


def map_few(function: Callable[..., jax.Array], *inputs: jax.Array) -> jax.Array:
    """Maps a function over the rows of arrays `[C, ...]`, a few at a time."""
    if inputs[0].shape[0] <= SCORED_TOGETHER:
        return jax.vmap(function)(*inputs)
    return jax.lax.map(lambda row: function(*row), inputs, batch_size=SCORED_TOGETHER)
