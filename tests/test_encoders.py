"""The grid's building blocks against slow or independent oracles."""

import functools
import heapq

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.domains.babyai.encoders import cells, convolutions, distances, instructions
from tests.quick import quick_jit

SIDE = 6


@pytest.fixture(scope="module")
def field():
    """Random starts and costs `[SIDE, SIDE, 2]`, without ties."""
    start = jax.random.uniform(jax.random.key(0), (SIDE, SIDE, 2)) * 20
    cost = jax.random.uniform(jax.random.key(1), (SIDE, SIDE, 2)) + 0.1
    return start, cost


def dijkstra(start, cost):
    """Distances of one field, by a priority queue."""
    distance = start.copy()
    queue = [(float(start[cell]), cell) for cell in np.ndindex(start.shape)]
    heapq.heapify(queue)
    while queue:
        length, (x, y) = heapq.heappop(queue)
        if length > distance[x, y]:
            continue
        for near in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
            if 0 <= near[0] < SIDE and 0 <= near[1] < SIDE:
                longer = length + cost[near]
                if longer < distance[near]:
                    distance[near] = longer
                    heapq.heappush(queue, (float(longer), near))
    return distance


def unrolled(start, cost, sweeps):
    """The recursion as it is written, for autodiff."""

    def sweep(distance, _):
        padded = jnp.pad(distance, ((1, 1), (1, 1), (0, 0)), constant_values=distances.FAR)
        near = [padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]
        return jnp.minimum(start, cost + jnp.stack(near).min(axis=0)), None

    return jax.lax.scan(sweep, start, length=sweeps)[0]


def test_distances_are_dijkstras_and_their_gradient_autodiffs(field):
    weights = jax.random.normal(jax.random.key(2), (SIDE, SIDE, 2))

    def differentiate(function):
        def loss(start, cost):
            distance = function(start, cost, SIDE**2)
            return (weights * distance).sum(), distance

        return jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(*field)

    gradient, distance = differentiate(distances.find_distances)
    for channel in range(2):
        expected = dijkstra(*(np.asarray(x)[..., channel] for x in field))
        np.testing.assert_allclose(distance[..., channel], expected, rtol=1e-5)
    for ours, expected in zip(gradient, differentiate(unrolled)[0], strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-5)


def test_a_long_way_that_is_free_is_nearer_than_a_short_one_that_is_blocked():
    odds = np.full((SIDE, SIDE, 1), 0.001 / 0.999)  # of being blocked
    odds[2, :-1] = 0.95 / 0.05  # a wall with a gap at its end
    cost = distances.compute_entering_cost(jnp.log(odds))
    np.testing.assert_allclose(cost[2, 0, 0], 1 - distances.BARRIER * np.log(0.05), rtol=1e-5)
    start = jnp.full((SIDE, SIDE, 1), distances.FAR).at[3, 0].set(0.0)
    distance = distances.find_distances(start, cost, SIDE**2)[..., 0]
    np.testing.assert_allclose(distance[1, 0], 2 * (SIDE - 1) + 2, rtol=0.01)  # around it


@pytest.mark.parametrize(
    ("side", "padding", "stride"), [(3, (1, 1), 1), (2, (1, 1), 1), (2, (0, 0), 1), (3, (1, 1), 2)]
)
def test_a_convolution_is_xlas(side, padding, stride):
    image = jax.random.normal(jax.random.key(0), (5, 7, 3))
    layer = convolutions.Convolution(4, side, padding, stride)
    params = layer.init(jax.random.key(1), image)
    kernel = params["params"]["Dense_0"]["kernel"].reshape(side, side, 3, 4)
    expected = jax.lax.conv_general_dilated(
        image[None], kernel, (stride, stride), (padding, padding),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )[0]  # fmt: skip
    np.testing.assert_allclose(layer.apply(params, image), expected, atol=1e-5)


def test_reading_around_and_at_a_cell():
    image = jnp.arange(SIDE * SIDE * 2, dtype=jnp.float32).reshape(SIDE, SIDE, 2)
    padded = np.pad(np.asarray(image), ((2, 2), (2, 2), (0, 0)))
    for x, y in ((0, 0), (3, 2), (5, 5)):
        around = cells.read_neighbourhood(image, jnp.array([x, y]), 2)
        np.testing.assert_array_equal(around, padded[x : x + 5, y : y + 5].reshape(-1))
        np.testing.assert_array_equal(cells.read_cell(image, jnp.array([x, y])), image[x, y])
    assert not cells.mark_cell(jnp.array([-1, -1]), SIDE).any()
    np.testing.assert_array_equal(cells.read_cell(image, jnp.array([-1, -1])), [0, 0])


def test_the_state_after_the_last_word_ignores_padding():
    encoder, words = instructions.InstructionEncoder(10, 8), jnp.array([3, 1, 4, 0, 0])
    params = jax.jit(encoder.init)(jax.random.key(0), words)
    encode = functools.partial(jax.jit(encoder.apply), params)
    short, long = encode(words[:3]), encode(words)
    np.testing.assert_allclose(long.whole, short.whole, atol=1e-6)
    np.testing.assert_allclose(long.words[:3], short.words, atol=1e-6)
    assert long.given.tolist() == [True] * 3 + [False] * 2
    for other in ([1, 3, 4], [3, 1, 0], [3, 1, 6]):
        assert not np.allclose(encode(jnp.array(other)).whole, short.whole)


def test_cells_attend_to_the_words_that_are_given():
    encoder, attention = instructions.InstructionEncoder(10, 8), instructions.WordAttention(2, 4)
    grid = jax.random.normal(jax.random.key(0), (3, 4, 5))
    encoded = jax.jit(encoder.init_with_output)(jax.random.key(1), jnp.array([3, 1, 4]))[0]
    params = jax.jit(attention.init)(jax.random.key(2), grid, encoded)
    attend = functools.partial(jax.jit(attention.apply), params)
    said = attend(grid, encoded)
    assert said.shape == grid.shape
    padded = jax.tree.map(lambda x: jnp.concatenate([x, 100 * x]), encoded)
    padded = padded._replace(given=jnp.arange(6) < 3, whole=encoded.whole)
    np.testing.assert_allclose(attend(grid, padded), said, atol=1e-6)
    # Each cell by itself, and none is told the same as another.
    np.testing.assert_allclose(attend(grid[1:2, 2:3], encoded)[0, 0], said[1, 2], atol=1e-6)
    assert np.unique(np.asarray(said).reshape(12, -1).round(4), axis=0).shape[0] == 12


@pytest.mark.parametrize("shape", [(4, 4, 3), (5, 7, 2)])
def test_halving_is_max_pooling(shape):
    """Its gradient too, where the largest is one cell."""
    image = jax.random.normal(jax.random.key(0), shape)
    ours, usual = (
        jax.value_and_grad(lambda x, pool=pool: (pool(x) ** 2).sum())(image)
        for pool in (convolutions.halve, lambda x: nn.max_pool(x, (2, 2), (2, 2)))
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), ours, usual)


@pytest.mark.parametrize("shape", [(4, 4, 16), (3, 5, 24), (1, 1, 8)])
def test_groups_are_normalised_as_by_flax(shape):
    """Its gradients too, by the image, the scale and the bias."""
    keys = jax.random.split(jax.random.key(0), 4)
    image = 3 * jax.random.normal(keys[0], shape) + 2
    weights = jax.random.normal(keys[1], shape)
    params = {"params": {"scale": jax.random.normal(keys[2], shape[2:]), "bias": weights[0, 0]}}

    def loss(module):
        def of(params, image):
            normalised = module.apply(params, image)
            return (normalised * weights).sum(), normalised

        return quick_jit(jax.value_and_grad(of, argnums=(0, 1), has_aux=True))(params, image)

    ours, usual = loss(convolutions.GroupNorm()), loss(nn.GroupNorm(convolutions.NORM_GROUPS))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), ours, usual)
