"""The building blocks of the grid encoder, compared with slow or independent oracles."""

import functools
import heapq

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.encoders import cells, convolutions, distances, instructions, memory
from leapjax.domains.babyai.encoders.context_tokens import ContextTokens
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from leapjax.types import Context, pad_token
from tests.parameters import random_like
from tests.programs import only_long
from tests.quick import quick_jit

SIDE = 6


@pytest.fixture(scope="module")
def field():
    """Random starts and costs `[SIDE, SIDE, 2]`, without ties."""
    start = jax.random.uniform(jax.random.key(0), (SIDE, SIDE, 2)) * 20
    cost = jax.random.uniform(jax.random.key(1), (SIDE, SIDE, 2)) + 0.1
    return start, cost


def dijkstra(start, cost):
    """Computes the distances of one field with a priority queue."""
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


def iterate_sweeps(start, cost, sweeps):
    """Computes distances by the plain recursion, for autodiff."""

    def sweep(distance, _):
        padded = jnp.pad(distance, ((1, 1), (1, 1), (0, 0)), constant_values=distances.FAR)
        near = [padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]
        return jnp.minimum(start, cost + jnp.stack(near).min(axis=0)), None

    return jax.lax.scan(sweep, start, length=sweeps)[0]


def test_distances_and_gradients_equal_dijkstra_and_autodiff(field):
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
    for ours, expected in zip(gradient, differentiate(iterate_sweeps)[0], strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-5)


def test_a_free_detour_is_shorter_than_a_blocked_path():
    odds = np.full((SIDE, SIDE, 1), 0.001 / 0.999)  # odds that a cell is blocked
    odds[2, :-1] = 0.95 / 0.05  # a wall with a gap at its end
    cost = distances.compute_entering_cost(jnp.log(odds))
    np.testing.assert_allclose(cost[2, 0, 0], 1 - distances.BARRIER * np.log(0.05), rtol=1e-5)
    start = jnp.full((SIDE, SIDE, 1), distances.FAR).at[3, 0].set(0.0)
    distance = distances.find_distances(start, cost, SIDE**2)[..., 0]
    np.testing.assert_allclose(distance[1, 0], 2 * (SIDE - 1) + 2, rtol=0.01)  # around the wall


@pytest.mark.parametrize(
    ("side", "padding", "stride"), [(3, (1, 1), 1), (2, (1, 1), 1), (2, (0, 0), 1), (3, (1, 1), 2)]
)
def test_convolution_equals_xla(side, padding, stride):
    image = jax.random.normal(jax.random.key(0), (5, 7, 3))
    layer = convolutions.Convolution(4, side, padding, stride)
    params = layer.init(jax.random.key(1), image)
    kernel = params["params"]["Dense_0"]["kernel"].reshape(side, side, 3, 4)
    expected = jax.lax.conv_general_dilated(
        image[None], kernel, (stride, stride), (padding, padding),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )[0]  # fmt: skip
    np.testing.assert_allclose(layer.apply(params, image), expected, atol=1e-5)


def test_cells_and_their_neighbourhoods_are_read_with_zero_padding():
    image = jnp.arange(SIDE * SIDE * 2, dtype=jnp.float32).reshape(SIDE, SIDE, 2)
    padded = np.pad(np.asarray(image), ((2, 2), (2, 2), (0, 0)))
    for x, y in ((0, 0), (3, 2), (5, 5)):
        around = cells.read_neighbourhood(image, jnp.array([x, y]), 2)
        np.testing.assert_array_equal(around, padded[x : x + 5, y : y + 5].reshape(-1))
        np.testing.assert_array_equal(cells.read_cell(image, jnp.array([x, y])), image[x, y])
    assert not cells.mark_cell(jnp.array([-1, -1]), SIDE).any()
    np.testing.assert_array_equal(cells.read_cell(image, jnp.array([-1, -1])), [0, 0])


def test_instruction_encodings_ignore_padding():
    encoder, words = instructions.InstructionEncoder(10, 8), jnp.array([3, 1, 4, 0, 0])
    params = jax.jit(encoder.init)(jax.random.key(0), words)
    encode = functools.partial(jax.jit(encoder.apply), params)
    short, long = encode(words[:3]), encode(words)
    np.testing.assert_allclose(long.whole, short.whole, atol=1e-6)
    np.testing.assert_allclose(long.words[:3], short.words, atol=1e-6)
    assert long.given.tolist() == [True] * 3 + [False] * 2
    for other in ([1, 3, 4], [3, 1, 0], [3, 1, 6]):
        assert not np.allclose(encode(jnp.array(other)).whole, short.whole)


def test_each_cell_attends_to_all_words_but_padding():
    encoder, attention = instructions.InstructionEncoder(10, 8), instructions.CrossAttention(2, 4)
    grid = jax.random.normal(jax.random.key(0), (3, 4, 5))
    encoded = jax.jit(encoder.init_with_output)(jax.random.key(1), jnp.array([3, 1, 4]))[0]
    params = jax.jit(attention.init)(jax.random.key(2), grid, encoded.words, encoded.given)
    apply = jax.jit(attention.apply)

    def attend(grid, output):
        return apply(params, grid, output.words, output.given)

    output = attend(grid, encoded)
    assert output.shape == grid.shape
    padded = jax.tree.map(lambda x: jnp.concatenate([x, 100 * x]), encoded)
    padded = padded._replace(given=jnp.arange(6) < 3, whole=encoded.whole)
    np.testing.assert_allclose(attend(grid, padded), output, atol=1e-6)
    # Each cell attends by itself, and all outputs differ.
    np.testing.assert_allclose(attend(grid[1:2, 2:3], encoded)[0, 0], output[1, 2], atol=1e-6)
    assert np.unique(np.asarray(output).reshape(12, -1).round(4), axis=0).shape[0] == 12


@pytest.mark.parametrize("shape", [(4, 4, 3), (5, 7, 2)])
def test_halving_equals_max_pooling(shape):
    """Gradients are equal too, if the maximum is unique."""
    image = jax.random.normal(jax.random.key(0), shape)
    ours, theirs = (
        jax.value_and_grad(lambda x, pool=pool: (pool(x) ** 2).sum())(image)
        for pool in (convolutions.halve, lambda x: nn.max_pool(x, (2, 2), (2, 2)))
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), ours, theirs)


@pytest.mark.parametrize("shape", [(4, 4, 16), (3, 5, 24), (1, 1, 8)])
def test_group_norm_equals_flax(shape):
    """Gradients by the image, the scale and the bias are equal too."""
    keys = jax.random.split(jax.random.key(0), 4)
    image = 3 * jax.random.normal(keys[0], shape) + 2
    weights = jax.random.normal(keys[1], shape)
    params = {"params": {"scale": jax.random.normal(keys[2], shape[2:]), "bias": weights[0, 0]}}

    def loss(module):
        def evaluate(params, image):
            normalised = module.apply(params, image)
            return (normalised * weights).sum(), normalised

        return quick_jit(jax.value_and_grad(evaluate, argnums=(0, 1), has_aux=True))(params, image)

    ours, theirs = loss(convolutions.GroupNorm()), loss(nn.GroupNorm(convolutions.NORM_GROUPS))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), ours, theirs)


@pytest.mark.parametrize("recall", [pytest.param(False, marks=only_long), True])
def test_padding_of_grid_and_instruction_changes_no_token(recall):
    """Checks every direction of the agent, in a level that is not square."""
    settings = Settings(fields=4, sweeps=12, word_heads=2, memory=recall, channels=8)
    encoder, rng = ContextTokens(settings, 16), np.random.default_rng(0)
    past, (width, height) = 3, (SIDE, SIDE - 1)
    grids = np.zeros((past + 1, SIDE, SIDE, 3), np.uint8)
    grids[:, :width, :height] = rng.integers([1, 0, 0], [8, 6, 4], (past + 1, width, height, 3))
    poses = rng.integers(0, [width, height, 4], (past + 1, 3)).astype(np.int32)
    states = Observation(
        grids, poses, np.tile(np.int32([5, 2]), (past + 1, 1)),
        np.tile(np.int32([1, 3]), (past + 1, 1)), np.tile(np.int32([4, 7, 2]), (past + 1, 1)),
    )  # fmt: skip
    actions = np.int32([3, 4, 5])

    def pad(extra):
        grid = np.pad(states.grid, ((0, 0), (0, extra), (0, extra), (0, 0)))
        words = np.pad(states.instruction, ((0, 0), (0, extra)))
        return states._replace(grid=grid, instruction=words)

    def context(states, direction):
        states = states._replace(pose=np.append(states.pose[:, :2], states.pose[:, 2:] * 0, 1))
        states.pose[-1, 2], states.pose[0, 2] = direction, 1
        now, before = (jax.tree.map(lambda x, w=w: x[w], states) for w in (-1, slice(past)))
        return Context(now, before, actions, np.zeros(past, np.float32), np.int32(past),
                       np.float32(0))  # fmt: skip

    shapes = jax.eval_shape(encoder.init, jax.random.key(0), context(states, 0))
    params, apply = random_like(shapes, 0.1), quick_jit(encoder.apply)
    for direction in range(4):
        tokens = apply(params, context(states, direction))
        for extra in (1, 5):
            padded = apply(params, context(pad(extra), direction))
            np.testing.assert_allclose(padded, tokens, rtol=1e-4, atol=1e-4)


def test_memory_marks_deeds_sides_of_the_first_pose_and_the_carried_object():
    """The agent faced down at (2, 3), picked up, moved, and now faces up at (2, 4)."""
    grid, nowhere = jnp.zeros((6, 6, 3), jnp.int32), np.int32([-1, -1])
    observation = Observation(grid, np.int32([2, 4, 3]), np.int32([5, 1]), nowhere, None)
    context = Context(
        observation,
        Observation(None, np.int32([[0, 0, 0], [2, 3, 1], [2, 3, 1]]), None, None, None),
        np.int32([pad_token(7), 3, 2]), np.zeros(3), np.int32(2), np.float32(0),
    )  # fmt: skip
    recall = quick_jit(lambda context, seen: memory.recall(context, symmetries.rotate(seen, 3)))
    features = np.asarray(recall(context, observation))
    # Three quarter turns move (x, y) to (5 - y, x).
    deeds = np.zeros((6, 6, 3))
    deeds[1, 2, 0] = 2 / 4
    np.testing.assert_array_equal(features[..., :3], deeds)
    unturned = np.array([[features[5 - y, x, 3:5] for y in range(6)] for x in range(6)])
    for x, y in np.ndindex(6, 6):
        np.testing.assert_array_equal(unturned[x, y], np.sign([y - 3, 2 - x]))
    carried_marks = features[1, 2, 5:]
    assert carried_marks.sum() == 2 and carried_marks[5] == carried_marks[11 + 1] == 1
    assert np.abs(features[..., 5:]).sum() == 2


@pytest.mark.parametrize("carried", [[0, 0], [5, 2], [5, 3]])
def test_matches_are_doors_and_objects_of_the_colour_of_a_locked_door(carried):
    """Doors of colours 2 and 4 are locked; the only door of colour 3 is closed."""
    grid = np.zeros((6, 6, 3), np.int32)
    grid[0, 1], grid[0, 2], grid[0, 3] = (4, 2, 2), (4, 4, 2), (4, 3, 1)  # locked, locked, closed
    grid[2, 1], grid[2, 2], grid[2, 3] = (5, 2, 0), (6, 4, 0), (5, 3, 0)  # key, ball, key
    grid[4, 1] = (2, 2, 2)  # a wall, whose colour does not count
    observation = Observation(grid, np.int32([3, 3, 0]), np.int32(carried), None, None)
    expected = np.zeros((6, 6))
    expected[0, 1] = expected[0, 2] = expected[2, 1] = expected[2, 2] = 1
    expected[3, 3] = carried == [5, 2]
    np.testing.assert_array_equal(memory.mark_matches(observation)[..., 0], expected)


def test_things_are_doors_keys_balls_boxes_and_the_agent():
    """Things are found at any cell; an index outside the grid pads the result."""
    rng = np.random.default_rng(0)
    for side, count in ((SIDE, SIDE**2), (12, cells.MOST_THINGS)):
        kinds = rng.choice([1, 1, 1, 2, 4, 5, 6, 7, 8, 9, 10], (side, side), p=[0.07] * 10 + [0.3])
        grid = np.stack([kinds] * 3, axis=-1)
        found = quick_jit(cells.find_things)(Observation(grid, None, None, None, None))
        expected = np.flatnonzero(np.isin(kinds, [4, 5, 6, 7, 10]))[:count]
        assert found.shape == (count,)
        np.testing.assert_array_equal(found[: len(expected)], expected)
        assert (np.asarray(found[len(expected) :]) == side**2).all()
