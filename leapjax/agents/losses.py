"""Losses that methods share: of one context, at its last P states."""

import jax
import jax.numpy as jnp
import optax

from leapjax.models.policy import past_and_present
from leapjax.types import Context, TransitionWindow


def actions_taken(
    context: Context, action: jax.Array, count: int, choices: int
) -> tuple[jax.Array, jax.Array]:
    """The action `[P]` that was taken at each of the last states, and where there was one.

    Args:
        context: of the current state.
        action: `[]` what was done there.
        count: P.
        choices: as many actions as can be chosen; 0 stands where the episode had not begun.
    """
    taken = past_and_present(context.actions, action, count)
    known = taken < choices
    return jnp.where(known, taken, 0), known


def last_actions(context: Context, count: int, choices: int) -> tuple[jax.Array, jax.Array]:
    """The same for the context of a `TransitionWindow`: up to the step that was taken."""
    return actions_taken(
        context._replace(actions=context.actions[:-1]), context.actions[-1], count, choices
    )


def bellman(transition: TransitionWindow, values: jax.Array, discount: float) -> jax.Array:
    """Each reward, and the discounted value of the state that it led to.

    Values are `[P]`, or `[P, N]` where there are several of each state; so are the results. No
    gradient flows through them. Only a transition's last step can have come to an end.
    """
    rewards = transition.context.rewards[-values.shape[0] :]
    goes_on = jnp.ones(values.shape[0]).at[-1].set(1.0 - transition.terminated)
    return jax.lax.stop_gradient((rewards + discount * goes_on * values.T).T)


def mean_where(values: jax.Array, known: jax.Array) -> jax.Array:
    """The mean `[]` of values `[P]` where they are known, which is once at least."""
    return jnp.where(known, values, 0).sum() / known.sum()


def of_action(values: jax.Array, actions: jax.Array) -> jax.Array:
    """Which of values `[P, choices, ...]` belong to actions `[P]`: `[P, ...]`."""
    chosen = jnp.expand_dims(actions, range(1, values.ndim))
    return jnp.take_along_axis(values, chosen, axis=1)[:, 0]


def imitation(
    logits: jax.Array, actions: jax.Array, known: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The cross-entropy `[]` of actions `[P]` under logits `[P, choices]`; and the accuracy."""
    likelihoods = of_action(jax.nn.log_softmax(logits), actions)
    hits = jnp.argmax(logits, axis=1) == actions
    return -mean_where(likelihoods, known), mean_where(hits, known)


def expectile(differences: jax.Array, share: float) -> jax.Array:
    """Squared differences, target minus estimate, whose mean is least at their expectile.

    Weighted by `share` where the target is above the estimate and by `1 - share` where it is
    below (Kostrikov et al., Implicit Q-Learning, equation 5).
    """
    return jnp.where(differences > 0, share, 1 - share) * differences**2


def quantile_huber(estimates: jax.Array, targets: jax.Array, kappa: float = 1.0) -> jax.Array:
    """The loss `[P]` that is least where estimates `[P, N]` are quantiles of targets `[P, M]`.

    Smooth where they differ by less than kappa; the sum over estimates, the mean over targets
    (Dabney et al., Distributional Reinforcement Learning with Quantile Regression, equation 10
    and algorithm 1).
    """
    count = estimates.shape[1]
    shares = (jnp.arange(count) + 0.5) / count  # lemma 2

    @jax.checkpoint
    def add(total: jax.Array, target: jax.Array) -> tuple[jax.Array, None]:
        errors = target[:, None] - estimates  # [P, N]
        weights = jnp.abs(shares - (errors < 0))
        return total + weights * optax.losses.huber_loss(errors, delta=kappa), None

    # One target after the other, computed again for the gradient: a sum over [P, N, M] at once
    # takes XLA on a CPU twenty times as long.
    total, _ = jax.lax.scan(add, jnp.zeros_like(estimates), targets.T)
    return total.sum(axis=1) / targets.shape[1]
