"""The losses that methods share, each against its definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from leapjax.agents import losses
from leapjax.types import Context, TransitionWindow

CHOICES = 3


def context(actions, rewards):
    return Context(None, None, jnp.array(actions), jnp.array(rewards), jnp.int32(9), jnp.float32(0))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_least_expectile_loss_is_at_the_expectile(share):
    sample = np.random.default_rng(0).gamma(2.0, size=500)
    found = optimize.minimize_scalar(
        lambda estimate: float(losses.expectile(jnp.array(sample - estimate), share).mean()),
        bounds=(0, 10), method="bounded",
    )  # fmt: skip
    assert found.x == pytest.approx(stats.expectile(sample, share), abs=1e-2)


def test_actions_of_the_last_states_and_which_there_were():
    given = context([4, 4, 1], [0.0, 0.0, 0.0])  # 4 is PAD
    for count, taken, known in ((1, [2], [True]), (3, [0, 1, 2], [False, True, True])):
        found = losses.actions_taken(given, jnp.array(2), count, CHOICES)
        assert [x.tolist() for x in found] == [taken, known]
    # A transition's context ends with the action that was taken.
    found = losses.last_actions(context([4, 4, 1, 2], [0.0] * 4), 3, CHOICES)
    assert [x.tolist() for x in found] == [[0, 1, 2], [False, True, True]]


@pytest.mark.parametrize("terminated", [False, True])
def test_bellman_targets(terminated):
    transition = TransitionWindow(context([0, 1, 2], [5.0, 1.0, 2.0]), jnp.array(terminated))
    values = jnp.array([10.0, 20.0])
    expected = [1 + 0.5 * 10, 2 + 0.5 * 20 * (not terminated)]
    np.testing.assert_allclose(losses.bellman(transition, values, 0.5), expected)
    gradient = jax.grad(lambda v: losses.bellman(transition, v, 0.5).sum())(values)
    np.testing.assert_array_equal(gradient, [0, 0])


@pytest.mark.parametrize("kappa", [0.3, 1.0])
def test_the_quantile_huber_loss_is_what_loops_say(kappa):
    rng = np.random.default_rng(0)
    estimates, targets = rng.normal(size=(2, 4)), 2 * rng.normal(size=(2, 3))
    expected = np.zeros(2)
    for p in range(2):
        for i, share in enumerate([1 / 8, 3 / 8, 5 / 8, 7 / 8]):
            for target in targets[p]:
                error = target - estimates[p, i]
                small = abs(error) <= kappa
                huber = error**2 / 2 if small else kappa * (abs(error) - kappa / 2)
                expected[p] += (1 - share if error < 0 else share) * huber / 3
    found = losses.quantile_huber(jnp.array(estimates), jnp.array(targets), kappa)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_least_quantile_huber_loss_is_at_the_quantiles():
    sample = np.random.default_rng(0).gamma(2.0, size=2000)
    expected = stats.gamma(2.0).ppf([1 / 8, 3 / 8, 5 / 8, 7 / 8])
    targets = jnp.array(sample)[None]
    loss = jax.jit(lambda estimates: losses.quantile_huber(estimates, targets, 1e-3)[0])
    for place, quantile in enumerate(expected):  # each has a least of its own
        others = jnp.array(expected)[None]
        found = optimize.minimize_scalar(
            lambda x, others=others, place=place: float(loss(others.at[0, place].set(x)) * 1e3),
            bounds=(0, 10), method="bounded",
        )  # fmt: skip
        assert found.x == pytest.approx(quantile, abs=0.1)


def test_imitation_counts_what_is_known_alone():
    likelihoods = jnp.array([[0.2, 0.3, 0.5], [0.5, 0.25, 0.25], [0.1, 0.8, 0.1]])
    loss, accuracy = losses.imitation(
        jnp.log(likelihoods) + 7, jnp.array([0, 0, 2]), jnp.array([False, True, True])
    )
    assert float(loss) == pytest.approx(-(np.log(0.5) + np.log(0.1)) / 2, rel=1e-5)
    assert accuracy == 0.5
