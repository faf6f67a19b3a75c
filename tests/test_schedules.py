"""Masks and corruptions of actions in training."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.agents.classifier import corrupt
from leapjax.schedules import MASKINGS, sample_masks
from tests.enumerable import fit_p_value
from tests.quick import quick_jit

HORIZON = 4
DRAWS = 4000
KEYS = jax.random.split(jax.random.key(0), DRAWS)
UNIFORM = np.full(HORIZON, 1 / HORIZON)


def draw_masks(masking):
    """Draws many masks `[DRAWS, copies, T]`."""
    draw = quick_jit(jax.vmap(lambda key: sample_masks(key, HORIZON, masking)))
    masks = np.asarray(draw(KEYS))
    assert masks.dtype == bool
    return masks


def test_masks_without_a_choice_are_fixed():
    np.testing.assert_array_equal(draw_masks("each"), np.tile(np.eye(HORIZON), (DRAWS, 1, 1)))
    np.testing.assert_array_equal(draw_masks("all"), np.ones((DRAWS, 1, HORIZON)))
    for masking in MASKINGS:
        np.testing.assert_array_equal(sample_masks(jax.random.key(3), 1, masking), [[True]])


@pytest.mark.parametrize(("masking", "counts"), [("one", [1]), ("random", [1, 2, 3, 4])])
def test_masked_positions_and_their_number_are_uniform(masking, counts):
    sets = draw_masks(masking)[:, 0] @ (2 ** np.arange(HORIZON))
    sizes = [bin(each).count("1") for each in range(2**HORIZON)]
    expected = [(n in counts) / len(counts) / math.comb(HORIZON, n) for n in sizes]
    assert fit_p_value(np.bincount(sets, minlength=2**HORIZON), expected) > 1e-3


def test_stratified_masks_every_number_of_positions():
    masks = draw_masks("stratified")
    np.testing.assert_array_equal(masks.sum(-1), np.tile(np.arange(HORIZON) + 1, (DRAWS, 1)))
    one, two = masks[:, 0], masks[:, 1]
    assert fit_p_value(one.sum(0), UNIFORM) > 1e-3
    # Copies are independent: the second masks the position of the first by chance.
    inside = (two & one).any(-1).sum()
    assert fit_p_value([inside, DRAWS - inside], [2 / HORIZON, 1 - 2 / HORIZON]) > 1e-3


@pytest.mark.parametrize(
    ("horizon", "masking", "message"),
    [
        (HORIZON, "One", r"unknown masking.*one, each, all, random"),
        (0, "one", "horizon must be"),
        (2.0, "one", "horizon must be"),
    ],
)
def test_invalid_masks_raise_an_error(horizon, masking, message):
    with pytest.raises(ValueError, match=message):
        sample_masks(jax.random.key(0), horizon, masking)


def test_degree_of_corruption_is_the_share_of_replaced_actions():
    choices, actions = 4, jnp.array([0, 2, 2, 3])

    @quick_jit
    def corrupt_actions(imitated):
        return jax.vmap(corrupt, (0, None, None, None))(KEYS, actions, imitated, choices)

    corrupted, degrees = corrupt_actions(jnp.ones(HORIZON, bool))
    changed = np.asarray(corrupted != actions)
    np.testing.assert_allclose(changed.mean(axis=1), degrees)
    # Degrees, positions and the new actions are uniform.
    assert fit_p_value(np.bincount(changed.sum(axis=1), minlength=5), np.full(5, 0.2)) > 1e-3
    np.testing.assert_allclose(changed.mean(axis=0), 0.5, atol=0.04)
    shares = np.bincount(corrupted[changed[:, 1], 1], minlength=choices)
    assert fit_p_value(shares, [1 / 3, 1 / 3, 0, 1 / 3]) > 1e-3
    # Actions that are not imitated count as corrupted, replaced or not.
    imitated = jnp.array([False, True, False, True])
    corrupted, degrees = corrupt_actions(imitated)
    np.testing.assert_allclose(((corrupted != actions) | ~imitated).mean(axis=1), degrees)
