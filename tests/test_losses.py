"""Minima of the losses that methods share; test_by_hand.py tests the losses of each method."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from leapjax.agents import losses

SAMPLE = np.random.default_rng(0).gamma(2.0, size=2000)


def minimise(loss):
    return optimize.minimize_scalar(lambda x: float(loss(x)), bounds=(0, 10), method="bounded").x


@pytest.mark.parametrize("level", [0.1, 0.9])
def test_expectile_loss_is_minimal_at_the_expectile(level):
    minimiser = minimise(
        lambda estimate: losses.expectile_loss(jnp.array(SAMPLE - estimate), level).mean()
    )
    assert minimiser == pytest.approx(stats.expectile(SAMPLE, level), abs=1e-2)


def test_quantile_huber_loss_is_minimal_at_the_quantiles():
    quantiles = jnp.array(stats.gamma(2.0).ppf([1 / 8, 3 / 8, 5 / 8, 7 / 8]))

    @jax.jit
    def loss(x, place):  # minimised for one quantile at a time
        estimates = quantiles.at[place].set(x)[None]
        return 1e3 * losses.quantile_huber_loss(estimates, jnp.array(SAMPLE)[None], 1e-3)[0]

    for place, quantile in enumerate(quantiles):
        assert minimise(lambda x, place=place: loss(x, place)) == pytest.approx(
            float(quantile), abs=0.1
        )


def test_accuracy_counts_only_known_actions():
    logits = jnp.log(jnp.array([[0.2, 0.3, 0.5], [0.5, 0.25, 0.25], [0.1, 0.8, 0.1]]))
    known = jnp.array([False, True, True])
    assert losses.imitation_loss(logits, jnp.array([0, 0, 2]), known)[1] == 0.5
