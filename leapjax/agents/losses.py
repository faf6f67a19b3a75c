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
        choices: number of actions that can be chosen.

    Returns:
        Actions `[P]`, 0 before the episode began, and booleans `[P]`.
    """
    taken = append_present(context.actions, action, count)
    known = taken < choices
    return jnp.where(known, taken, 0), known


def find_transition_actions(
    context: Context, count: int, choices: int
) -> tuple[jax.Array, jax.Array]:
    """Does the same as `find_actions_taken` for a transition, whose last action is in its context.

    Args:
        context: context of a `TransitionWindow`.
        count: P, number of states.
        choices: number of actions that can be chosen.
    """
    return find_actions_taken(
        context._replace(actions=context.actions[:-1]), context.actions[-1], count, choices
    )


def bellman_targets(transition: TransitionWindow, values: jax.Array, discount: float) -> jax.Array:
    """Adds each reward and the discounted value of the next state. It passes no gradient.

    Args:
        transition: has the rewards. The episode can terminate at its last step only.
        values: values of the next states, `[P]`, or N of each, `[P, N]`.
        discount: discount per step.

    Returns:
        Targets of the shape of `values`.
    """
    rewards = transition.context.rewards[-values.shape[0] :]
    goes_on = jnp.ones(values.shape[0]).at[-1].set(1.0 - transition.terminated)
    return jax.lax.stop_gradient((rewards + discount * goes_on * values.T).T)


def average_where(values: jax.Array, known: jax.Array) -> jax.Array:
    """Averages values `[P]` where `known [P]` is True, which it is at least once."""
    return jnp.where(known, values, 0).sum() / known.sum()


def select_values(values: jax.Array, actions: jax.Array) -> jax.Array:
    """Selects the values of actions: `[P, choices, ...]` and `[P]` to `[P, ...]`."""
    chosen = jnp.expand_dims(actions, range(1, values.ndim))
    return jnp.take_along_axis(values, chosen, axis=1)[:, 0]


def imitation_loss(
    logits: jax.Array, actions: jax.Array, known: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the cross-entropy `[]` of actions, and the accuracy `[]`.

    Args:
        logits: logits `[P, choices]`.
        actions: actions `[P]`.
        known: booleans `[P]`: which actions count.
    """
    likelihoods = select_values(jax.nn.log_softmax(logits), actions)
    hits = jnp.argmax(logits, axis=1) == actions
    return -average_where(likelihoods, known), average_where(hits, known)


def expectile_loss(differences: jax.Array, share: float) -> jax.Array:
    """Returns the asymmetric squares whose mean is least at an expectile.

    Source: Kostrikov et al., Implicit Q-Learning, equation 5.

    Args:
        differences: targets minus estimates, of any shape.
        share: weight of positive differences; negative ones weigh `1 - share`.
    """
    return jnp.where(differences > 0, share, 1 - share) * differences**2


def quantile_huber_loss(estimates: jax.Array, targets: jax.Array, kappa: float = 1.0) -> jax.Array:
    """Returns the loss `[P]` that is least where the estimates are quantiles of the targets.

    It is the sum over estimates of the mean over targets. Source: Dabney et al., Distributional
    Reinforcement Learning with Quantile Regression, equation 10 and algorithm 1.

    Args:
        estimates: estimates `[P, N]` of the N quantiles.
        targets: samples `[P, M]`.
        kappa: the loss is quadratic where estimate and target differ by less.
    """
    count = estimates.shape[1]
    shares = (jnp.arange(count) + 0.5) / count  # lemma 2

    @jax.checkpoint
    def add(total: jax.Array, target: jax.Array) -> tuple[jax.Array, None]:
        errors = target[:, None] - estimates  # [P, N]
        weights = jnp.abs(shares - (errors < 0))
        return total + weights * optax.losses.huber_loss(errors, delta=kappa), None

    # The scan takes one target at a time, and recomputes it for the gradient: XLA on a CPU takes
    # twenty times as long for a sum over [P, N, M].
    total, _ = jax.lax.scan(add, jnp.zeros_like(estimates), targets.T)
    return total.sum(axis=1) / targets.shape[1]
