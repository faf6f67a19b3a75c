import jax
import numpy as np
import pytest

from leapjax.schedules import MASKINGS, sample_masks
from tests.enumerable import fit_p_value
from tests.quick import quick_jit

HORIZON = 4
DRAWS = 4000


@pytest.fixture(scope="module")
def masks():
    """Many draws `[DRAWS, copies, T]` of every way of masking."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return {
        masking: np.asarray(
            quick_jit(jax.vmap(lambda k, m=masking: sample_masks(k, HORIZON, m)))(keys)
        )
        for masking in MASKINGS
    }


def test_one_masks_exactly_one_uniformly(masks):
    one = masks["one"]
    assert one.shape == (DRAWS, 1, HORIZON)
    assert one.dtype == bool
    assert (one.sum(-1) == 1).all()
    assert fit_p_value(one[:, 0].sum(0), np.full(HORIZON, 1 / HORIZON)) > 1e-3


def test_each_masks_every_position_in_turn(masks):
    assert masks["each"].dtype == bool
    np.testing.assert_array_equal(masks["each"], np.broadcast_to(np.eye(HORIZON), (DRAWS, 4, 4)))


def test_all_masks_every_position_at_once(masks):
    assert masks["all"].shape == (DRAWS, 1, HORIZON)
    assert masks["all"].all()


def test_random_draws_a_uniform_count(masks):
    random = masks["random"]
    assert random.shape == (DRAWS, 1, HORIZON)
    counts = np.bincount(random.sum(-1)[:, 0], minlength=HORIZON + 1)
    assert counts[0] == 0
    assert fit_p_value(counts[1:], np.full(HORIZON, 1 / HORIZON)) > 1e-3


def test_random_draws_uniform_positions_given_the_count(masks):
    random = masks["random"][:, 0]
    pairs = random[random.sum(-1) == 2]
    index = pairs @ (2 ** np.arange(HORIZON))
    counts = np.bincount(index, minlength=2**HORIZON)
    possible = np.array([bin(i).count("1") == 2 for i in range(2**HORIZON)])
    assert fit_p_value(counts, possible / possible.sum()) > 1e-3


def test_stratified_masks_every_number_of_positions(masks):
    stratified = masks["stratified"]
    assert stratified.shape == (DRAWS, HORIZON, HORIZON) and stratified.dtype == bool
    np.testing.assert_array_equal(stratified.sum(-1), np.tile(np.arange(HORIZON) + 1, (DRAWS, 1)))
    one, two = stratified[:, 0], stratified[:, 1]
    assert fit_p_value(one.sum(0), np.full(HORIZON, 1 / HORIZON)) > 1e-3
    # The copies are drawn on their own: those of one position lie in those of two by chance.
    inside = (two & one).any(-1).sum()
    assert fit_p_value([inside, DRAWS - inside], [2 / HORIZON, 1 - 2 / HORIZON]) > 1e-3


@pytest.mark.parametrize("masking", MASKINGS)
def test_a_single_action_is_always_masked(masking):
    np.testing.assert_array_equal(sample_masks(jax.random.key(3), 1, masking), [[True]])


@pytest.mark.parametrize("masking", ["", "One", "none"])
def test_unknown_masking_is_refused(masking):
    with pytest.raises(ValueError, match=r"unknown masking.*one, each, all, random"):
        sample_masks(jax.random.key(0), HORIZON, masking)


@pytest.mark.parametrize("horizon", [0, -1, 2.0, True, None])
def test_a_window_without_a_length_is_refused(horizon):
    with pytest.raises(ValueError, match="horizon must be"):
        sample_masks(jax.random.key(0), horizon, "one")
