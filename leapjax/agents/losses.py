"""Losses that methods share. Each takes one example: a context with its last P states."""

import jax
import jax.numpy as jnp
import optax

from leapjax.models.policy import append_present
from leapjax.types import Context, TransitionWindow


def find_actions_taken(
    context: Context, action: jax.Array, count: int, choices: int
) -> tuple[jax.Array, jax.Array]:
    """Returns the action taken at each of the last P states, and whether the episode had begun.

    Args:
        context: context of the current state.
        action: action `[]` taken at the current state.
        count: P, number of states.
        choices: A - 1, number of actions without the end.

    Returns:
        Actions `[P]`, 0 before the episode began, and booleans `[P]`.
    """
    taken = append_present(context.actions, action, count)
    known = taken < choices
    return jnp.where(known, taken, 0), known


def find_transition_actions(
    context: Context, count: int, choices: int
) -> tuple[jax.Array, jax.Array]:
    """Applies `find_actions_taken` to a transition, whose context holds the last action.

    Args:
        context: context of a `TransitionWindow`.
        count: P, number of states.
        choices: A - 1, number of actions without the end.
    """
    return find_actions_taken(
        context._replace(actions=context.actions[:-1]), context.actions[-1], count, choices
    )


def bellman_targets(transition: TransitionWindow, values: jax.Array, discount: float) -> jax.Array:
    """Adds each reward and the discounted value of the next state, without a gradient.

    Args:
        transition: transition with the rewards; only its last step can terminate the episode.
        values: values `[P]` of the next states, or N values of each, `[P, N]`.
        discount: discount per step.

    Returns:
        Targets of the shape of `values`.
    """
    rewards = transition.context.rewards[-values.shape[0] :]
    goes_on = jnp.ones(values.shape[0]).at[-1].set(1.0 - transition.terminated)
    return jax.lax.stop_gradient((rewards + discount * goes_on * values.T).T)


def average_where(values: jax.Array, known: jax.Array) -> jax.Array:
    """Averages values `[P]` where `known [P]` is True; 0 where nothing is."""
    return jnp.where(known, values, 0).sum() / jnp.maximum(known.sum(), 1)


def select_values(values: jax.Array, actions: jax.Array) -> jax.Array:
    """Selects from values `[P, choices, ...]` the values `[P, ...]` of actions `[P]`."""
    chosen = jnp.expand_dims(actions, range(1, values.ndim))
    return jnp.take_along_axis(values, chosen, axis=1)[:, 0]


def imitation_loss(
    logits: jax.Array, actions: jax.Array, known: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the cross-entropy `[]` of actions, and the accuracy `[]`.

    Args:
        logits: logits `[P, choices]`.
        actions: actions `[P]`.
        known: booleans `[P]`, True where an action counts.
    """
    likelihoods = select_values(jax.nn.log_softmax(logits), actions)
    hits = jnp.argmax(logits, axis=1) == actions
    return -average_where(likelihoods, known), average_where(hits, known)


def expectile_loss(differences: jax.Array, share: float) -> jax.Array:
    """Returns asymmetrically weighted squares; an expectile minimises their mean.

    Source: Kostrikov et al., Implicit Q-Learning, equation 5.

    Args:
        differences: targets minus estimates, of any shape.
        share: weight of positive differences; negative ones weigh `1 - share`.
    """
    return jnp.where(differences > 0, share, 1 - share) * differences**2


def quantile_huber_loss(estimates: jax.Array, targets: jax.Array, kappa: float = 1.0) -> jax.Array:
    """Returns the loss `[P]` that is least where the estimates are quantiles of the targets.

    It averages over the targets and sums over the estimates. Source: Dabney et al., Distributional
    Reinforcement Learning with Quantile Regression, equation 10 and algorithm 1.

    Args:
        estimates: estimates `[P, N]` of the N quantiles.
        targets: samples `[P, M]`.
        kappa: difference of estimate and target below which the loss is quadratic.
    """
    count = estimates.shape[1]
    shares = (jnp.arange(count) + 0.5) / count  # lemma 2

    @jax.checkpoint
    def add(total: jax.Array, target: jax.Array) -> tuple[jax.Array, None]:
        errors = target[:, None] - estimates  # [P, N]
        weights = jnp.abs(shares - (errors < 0))
        return total + weights * optax.losses.huber_loss(errors, delta=kappa), None

    # The scan takes a target at a time, and computes its loss again for the gradient. On a CPU, XLA
    # takes twenty times as long for a sum over [P, N, M].
    total, _ = jax.lax.scan(add, jnp.zeros_like(estimates), targets.T)
    return total.sum(axis=1) / targets.shape[1]
