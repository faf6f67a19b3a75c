"""Planners over many complete plans: random shooting and the cross-entropy method."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.checks import check_kind
from leapjax.planners.configs import CrossEntropyConfig, ShootingConfig
from leapjax.planners.guard import check_constraints, compute_totals, guard_shapes, is_undefined
from leapjax.types import Energy, Params, Plan, PyTree, mask_token


class _Choices(NamedTuple):
    """The possible actions at every position.

    Attributes:
        logits: `[T, A]`, 0 for a possible action, -inf for another.
        valid: `[]` bool: every energy was defined.
        passes: number of conditionals that were computed.
    """

    logits: jax.Array
    valid: jax.Array
    passes: int


def _find_choices(energy: Energy, params: Params, memory: PyTree, horizon: int) -> _Choices:
    """Finds the possible actions at every position.

    An action is impossible if its energy is infinite while all positions are MASK: no later choice
    changes that. An example is the end action at the first position. If the energy does not accept
    MASK, every action counts as possible.
    """
    if not energy.accepts_mask:
        return _Choices(jnp.zeros((horizon, energy.num_actions)), jnp.array(True), 0)
    blank = jnp.full((horizon,), mask_token(energy.num_actions), jnp.int32)
    energies = energy.conditional(params, memory, blank, jnp.arange(horizon))
    logits = jnp.where(jnp.isposinf(energies), -jnp.inf, 0.0)
    return _Choices(logits, ~jnp.any(is_undefined(energies)), 1)


def _draw_plans(key: jax.Array, logits: jax.Array, count: int) -> jax.Array:
    """Draws plans `[C, T]` of uniform possible actions, see `_Choices`."""
    plans = jax.random.categorical(key, logits, shape=(count, logits.shape[0]))
    return plans.astype(jnp.int32)


def random_shooting(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: ShootingConfig
) -> Plan:
    """Draws possible plans at random, and returns the plan of least energy (paper, ablation)."""
    check_kind(config, ShootingConfig)
    energy = guard_shapes(energy)
    choices = _find_choices(energy, params, memory, config.horizon)
    plans = _draw_plans(key, choices.logits, config.candidates)
    energies = compute_totals(energy, params, memory, plans)
    best = jnp.argmin(energies)
    satisfied, defined = check_constraints(energy, params, memory, plans[best])
    plan = Plan(
        plans[best],
        plans[best][None],
        satisfied,
        choices.valid & defined & ~jnp.any(is_undefined(energies)),
        jnp.asarray(choices.passes + plans.size, jnp.int32),
    )
    return plan._replace(energy=energies[best]) if config.score else plan


def cross_entropy_method(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: CrossEntropyConfig
) -> Plan:
    """Keeps the elites, and changes one token in each child (paper, appendix, ablation).

    It returns the best plan of the last round, as in the paper. Elites survive unchanged, so this
    is also the best plan of all rounds.
    """
    check_kind(config, CrossEntropyConfig)
    energy = guard_shapes(energy)
    count, horizon = config.candidates, config.horizon
    choices = _find_choices(energy, params, memory, horizon)

    def score(plans: jax.Array) -> jax.Array:
        return compute_totals(energy, params, memory, plans)

    def breed(
        carry: tuple[jax.Array, jax.Array], round_key: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        plans, energies = carry
        parents = plans[jnp.argsort(energies)[: config.elites]]
        place_key, action_key = jax.random.split(round_key)
        children = parents[jnp.arange(count) % config.elites]
        where = jax.random.randint(place_key, (count,), 0, horizon)
        rows = jnp.arange(count)
        # Draw another action. Without a possible one, the lowest finite logit keeps the same.
        lowest = jnp.finfo(choices.logits.dtype).min
        others = choices.logits[where].at[rows, children[rows, where]].set(lowest)
        changed = jax.random.categorical(action_key, others).astype(jnp.int32)
        children = children.at[rows, where].set(changed)
        children = children.at[: config.elites].set(parents)
        energies = score(children)
        return (children, energies), (children[jnp.argmin(energies)], is_undefined(energies).any())

    first_key, loop_key = jax.random.split(key)
    plans = _draw_plans(first_key, choices.logits, count)
    energies = score(plans)
    first, first_invalid = plans[jnp.argmin(energies)], is_undefined(energies).any()
    keys = jax.random.split(loop_key, config.iterations)[1:]
    (plans, energies), (later, invalid) = jax.lax.scan(breed, (plans, energies), keys)
    best = jnp.argmin(energies)
    satisfied, defined = check_constraints(energy, params, memory, plans[best])
    plan = Plan(
        plans[best],
        jnp.concatenate([first[None], later]),
        satisfied,
        choices.valid & defined & ~(first_invalid | invalid.any()),
        jnp.asarray(choices.passes + config.iterations * count * horizon, jnp.int32),
    )
    return plan._replace(energy=energies[best]) if config.score else plan
