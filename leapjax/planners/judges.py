"""Which complete plan is best: judges by name, functions of one plan."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.planners.guard import score_open
from leapjax.types import Energy, Params, PyTree, mask_token

SPLITS = 3  # random splits of a plan into two halves


class Judge(NamedTuple):
    """A way to compare complete plans.

    Attributes:
        score: (energy, params, memory, key, plan `[T]`) -> `[]`; the least is best.
        count_passes: (T) -> passes of the model for one plan.
        masks: whether the judge masks actions, so that the energy must accept MASK.
    """

    score: Callable[[Energy, Params, PyTree, jax.Array, jax.Array], jax.Array]
    count_passes: Callable[[int], int]
    masks: bool = False


def sum_energies(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, plan: jax.Array
) -> jax.Array:
    """Returns the total energy of a plan `[T]`."""
    del key
    return energy.total(params, memory, plan)


def sum_halves(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, plan: jax.Array
) -> jax.Array:
    """Returns the energies of a plan's actions `[T]` with half of the plan in view, summed.

    A random half of the plan is masked and its actions are scored in one pass, then those of the
    other half. `SPLITS` random splits are summed. A pseudo-likelihood has all other actions in
    view, and wrong actions confirm each other; here they are rarely all in view. The sum is in
    nats, and +inf if an action is forbidden or MASK. The violation of constraints is added.
    """
    positions = jnp.arange(plan.shape[0])
    keys = jax.random.split(key, SPLITS)
    halves = jax.vmap(lambda each: jax.random.permutation(each, positions % 2))(keys)

    def score(hidden: jax.Array) -> jax.Array:
        seen = jnp.where(hidden, mask_token(energy.num_actions), plan)
        energies = score_open(energy, params, memory, seen)
        forbidden = jnp.isposinf(energies[positions, plan])
        energies = jnp.where(jnp.all(jnp.isposinf(energies), axis=1, keepdims=True), 0, energies)
        costs = -jax.nn.log_softmax(-energies)[positions, plan]
        return jnp.where(hidden, jnp.where(forbidden, jnp.inf, costs), 0).sum()

    sums = jax.vmap(score)(jnp.concatenate([halves == 0, halves == 1]))
    cost = sums.sum() + energy.violation(params, memory, plan)
    return jnp.where(jnp.all(plan < energy.num_actions), cost, jnp.inf)


JUDGES: Mapping[str, Judge] = {
    "energy": Judge(sum_energies, lambda horizon: horizon),
    "halves": Judge(sum_halves, lambda horizon: 2 * SPLITS, masks=True),
}
