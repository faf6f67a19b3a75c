"""A joint distribution over all A^T plans, small enough to enumerate.

`enumerable_energy` is an `Energy` with the exact conditionals of the joint; its total is the exact
negative logarithm. `joint_probabilities` and `conditional_by_counting` compute the reference values
in plain NumPy, by counting over all plans.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from scipy import stats

from leapjax.types import Energy, mask_token


def enumerable_energy(horizon: int, num_actions: int) -> Energy:
    """Makes the energy of a joint. The conditional marginalises over positions that hold MASK.

    Parameters are log weights `[A] * T`. The context is a tilt `[T, A]`, added to the log weights.
    The total of a plan that holds MASK is infinite.
    """
    mask = mask_token(num_actions)

    def encode(params, context):
        weights = params
        for t in range(horizon):
            weights = weights + _along_axis(context[t], t, horizon)
        weights = jnp.exp(weights - jnp.max(weights))
        return weights / jnp.sum(weights)  # the joint

    def conditional(params, memory, actions, positions):
        tokens = actions.at[positions].set(mask)
        possible = (tokens[:, None] == mask) | (tokens[:, None] == jnp.arange(num_actions))
        known = memory
        for t in range(horizon):
            known = known * _along_axis(possible[t], t, horizon)
        marginals = jnp.stack(
            [known.sum(tuple(s for s in range(horizon) if s != t)) for t in range(horizon)]
        )
        return -jnp.log(marginals[positions] / known.sum())

    def total(params, memory, actions):
        complete = jnp.all(actions < num_actions)
        return jnp.where(complete, -jnp.log(memory[tuple(actions)]), jnp.inf)

    return Energy(encode, conditional, total, num_actions)


def _along_axis(values, axis: int, axes: int):
    shape = [1] * axes
    shape[axis] = -1
    return values.reshape(shape)


def random_table(seed: int, horizon: int, num_actions: int, scale: float = 1.5) -> np.ndarray:
    """Draws log weights `[A] * T` of a joint whose actions depend on each other."""
    rng = np.random.default_rng(seed)
    return rng.normal(scale=scale, size=(num_actions,) * horizon).astype(np.float32)


def all_plans(horizon: int, num_actions: int) -> np.ndarray:
    """Lists all plans `[A^T, T]`, in the order of the flattened joint."""
    return np.array(list(itertools.product(range(num_actions), repeat=horizon)), np.int32)


def joint_probabilities(table: np.ndarray, tilt: np.ndarray | None = None) -> np.ndarray:
    """Computes the joint `[A] * T`, in float64."""
    weights = np.asarray(table, np.float64)
    if tilt is not None:
        weights = weights.copy()
        for plan in np.ndindex(*weights.shape):
            weights[plan] += sum(float(tilt[t, a]) for t, a in enumerate(plan))
    weights = np.exp(weights - weights.max())
    return weights / weights.sum()


def conditional_by_counting(joint: np.ndarray, tokens: np.ndarray, position: int) -> np.ndarray:
    """Computes p(action at position | the other tokens, except MASK) `[A]`."""
    num_actions = joint.shape[0]
    result = np.zeros(num_actions)
    for plan in np.ndindex(*joint.shape):
        is_consistent = all(
            t == position or tokens[t] == num_actions or tokens[t] == a for t, a in enumerate(plan)
        )
        if is_consistent:
            result[plan[position]] += joint[plan]
    return result / result.sum()


def plan_counts(plans: np.ndarray, num_actions: int) -> np.ndarray:
    """Counts how often each plan occurs: `[A^T]`, in the order of the flattened joint."""
    plans = np.asarray(plans)
    horizon = plans.shape[-1]
    index = plans @ (num_actions ** np.arange(horizon - 1, -1, -1))
    return np.bincount(index, minlength=num_actions**horizon)


def fit_p_value(counts: np.ndarray, probabilities: np.ndarray) -> float:
    """Returns the p-value of a chi-square test of counts; rare outcomes are pooled."""
    counts = np.asarray(counts, np.float64).reshape(-1)
    expected = np.asarray(probabilities, np.float64).reshape(-1) * counts.sum()
    if np.any(counts[expected == 0] > 0):
        return 0.0
    order = np.argsort(expected)
    counts, expected = counts[order], expected[order]
    # The classical rule: each class expects at least five counts.
    enough = np.searchsorted(np.cumsum(expected), 5.0) + 1
    counts = np.append(counts[:enough].sum(), counts[enough:])
    expected = np.append(expected[:enough].sum(), expected[enough:])
    return float(stats.chisquare(counts, expected).pvalue)
