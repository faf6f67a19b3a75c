"""What the losses that methods share are least at; test_by_hand.py has the losses of methods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from leapjax.agents import losses

SAMPLE = np.random.default_rng(0).gamma(2.0, size=2000)


def least(loss):
    return optimize.minimize_scalar(lambda x: float(loss(x)), bounds=(0, 10), method="bounded").x


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_the_least_expectile_loss_is_at_the_expectile(share):
    found = least(
        lambda estimate: losses.expectile_loss(jnp.array(SAMPLE - estimate), share).mean()
    )
    assert found == pytest.approx(stats.expectile(SAMPLE, share), abs=1e-2)


def test_the_least_quantile_huber_loss_is_at_the_quantiles():
    quantiles = jnp.array(stats.gamma(2.0).ppf([1 / 8, 3 / 8, 5 / 8, 7 / 8]))

    @jax.jit
    def loss(x, place):  # each has a least of its own
        estimates = quantiles.at[place].set(x)[None]
        return 1e3 * losses.quantile_huber_loss(estimates, jnp.array(SAMPLE)[None], 1e-3)[0]

    for place, quantile in enumerate(quantiles):
        assert least(lambda x, place=place: loss(x, place)) == pytest.approx(
            float(quantile), abs=0.1
        )


def test_accuracy_counts_what_is_known_alone():
    logits = jnp.log(jnp.array([[0.2, 0.3, 0.5], [0.5, 0.25, 0.25], [0.1, 0.8, 0.1]]))
    known = jnp.array([False, True, True])
    assert losses.imitation_loss(logits, jnp.array([0, 0, 2]), known)[1] == 0.5
