import dataclasses
import functools
import heapq
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.data import symmetries
from leapjax.energy import pseudo_likelihood
from leapjax.models import encoders
from leapjax.models.trajectory import ARCHITECTURES, ModelConfig, Sizes, blank_context, build
from leapjax.types import Context, Observation, mask_token, pad_token
from tests.enumerable import all_plans, quick_jit

# Of a smaller grid, pooling and normalisation leave the paper's network next to nothing.
SIDE = 7
EMPTY, WALL, BALL = 1, 2, 6
VOCABULARY, ACTIONS, HORIZON, WORDS, MAX_STEPS = 9, 5, 3, 4, 20
END, MASK, PAD = ACTIONS - 1, mask_token(ACTIONS), pad_token(ACTIONS)
EVERYWHERE = np.arange(HORIZON)


def tiny(architecture):
    return ModelConfig(
        architecture, layers=2, heads=2, width=16, channels=8, rounds=1, fields=2, sweeps=5,
        word_heads=2,
    )  # fmt: skip


@functools.cache
def model(architecture, past):
    """A tiny model with random parameters: `(params, evaluate)`.

    `evaluate(params, context, actions, position)` compiles once and returns the logits of
    the actions as they are, at all positions and at one alone; the energies of the
    conditional at one position and at all positions masked together; and the total energy.
    """
    sizes = Sizes(SIDE, VOCABULARY, ACTIONS, past, HORIZON, MAX_STEPS)
    config = tiny(architecture)
    module = build(config, sizes)

    def encode(params, context):
        return module.apply(params, context, method="encode")

    def logits(params, memory, actions, positions):
        return module.apply(params, memory, actions, positions, method="logits")

    def touch(module, context, actions):
        return module.logits(module.encode(context), actions, EVERYWHERE)

    energy = pseudo_likelihood(encode, logits, ACTIONS)

    @quick_jit
    def evaluate(params, context, actions, position):
        memory = encode(params, context)
        return {
            "logits": logits(params, memory, actions, EVERYWHERE),
            "alone": logits(params, memory, actions, position[None])[0],
            "conditional": energy.conditional(params, memory, actions, position[None])[0],
            "together": energy.conditional(params, memory, actions, EVERYWHERE),
            "total": energy.total(params, memory, actions),
        }

    shapes = jax.eval_shape(
        functools.partial(module.init, method=touch),
        jax.random.key(0),
        blank_context(sizes, WORDS),
        np.zeros(HORIZON, np.int32),
    )
    return random_parameters(shapes), evaluate


def random_parameters(shapes, seed=0):
    """No zeros and nothing tiny, as initialisation has: what leaks must show."""
    rng = np.random.default_rng(seed)

    def leaf(path, shape):
        kind = path[-1].key
        scale = shape.shape[-2] ** -0.5 if kind == "kernel" else 0.5
        value = rng.normal(scale=scale, size=shape.shape)
        return (value + (kind == "scale")).astype(np.float32)

    return jax.tree_util.tree_map_with_path(leaf, shapes)


def random_observation(rng, goal=True):
    grid = np.stack([rng.integers(0, n, (SIDE, SIDE)) for n in (10, 6, 4)], -1).astype(np.uint8)
    x, y, direction = *rng.integers(0, SIDE, 2), rng.integers(0, 4)
    grid[x, y] = symmetries.AGENT, 0, direction
    return Observation(
        grid=grid,
        pose=np.array([x, y, direction], np.int32),
        carried=np.array([rng.integers(5, 8), rng.integers(0, 6)], np.int32),
        goal=(rng.integers(0, SIDE, 2) if goal else np.array([-1, -1])).astype(np.int32),
        instruction=np.append(rng.integers(1, VOCABULARY, WORDS - 1), 0).astype(np.int32),
    )


def random_context(seed, past, goal=True):
    rng = np.random.default_rng(seed)
    observation = random_observation(rng, goal)
    steps = [random_observation(rng, goal) for _ in range(past)]
    empty = jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), observation)
    return Context(
        observation=observation,
        past=jax.tree.map(lambda *x: np.stack(x), *steps) if past else empty,
        actions=rng.integers(0, ACTIONS - 1, past).astype(np.int32),
        step=np.int32(past + 3),
    )


def run(architecture, past, context, actions, position=0):
    params, evaluate = model(architecture, past)
    results = evaluate(params, context, np.asarray(actions, np.int32), np.int32(position))
    return {name: np.asarray(value) for name, value in results.items()}


def log_softmax(logits):
    logits = logits.astype(np.float64)
    shifted = logits - logits.max(-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(-1, keepdims=True))


def largest_change(after, before):
    """Of the logits or energies that are finite."""
    finite = np.isfinite(before)
    np.testing.assert_array_equal(np.isfinite(after), finite)
    return np.abs(after[finite] - before[finite]).max()


EACH_MODEL = pytest.mark.parametrize("past", [0, 2])
EACH_ARCHITECTURE = pytest.mark.parametrize("architecture", ARCHITECTURES)


# What holds for both architectures.


@EACH_ARCHITECTURE
@EACH_MODEL
def test_end_is_forbidden_at_the_first_position_only(architecture, past):
    context = random_context(0, past)
    for actions in ([MASK] * 3, [0, 1, 2], [END] * 3):
        logits = run(architecture, past, context, actions)["logits"]
        expected = np.zeros((HORIZON, ACTIONS), bool)
        expected[0, END] = True
        np.testing.assert_array_equal(np.isneginf(logits), expected)
        assert np.isfinite(logits[~expected]).all()


@EACH_ARCHITECTURE
@EACH_MODEL
def test_only_plans_that_end_at_once_have_infinite_energy(architecture, past):
    context = random_context(1, past)
    for actions in all_plans(HORIZON, ACTIONS)[:: 7 if past else 3]:
        total = run(architecture, past, context, actions)["total"]
        assert np.isposinf(total) if actions[0] == END else np.isfinite(total)


@EACH_ARCHITECTURE
@EACH_MODEL
def test_total_is_a_loop_over_masked_positions(architecture, past):
    context = random_context(2, past)
    for actions in ([0, 1, 2], [3, END, END], [1, 1, 0]):
        expected = 0.0
        for t in range(HORIZON):
            masked = np.array(actions)
            masked[t] = MASK
            logits = run(architecture, past, context, masked)["logits"][t]
            expected -= log_softmax(logits)[actions[t]]
        total = run(architecture, past, context, actions)["total"]
        assert total == pytest.approx(expected, rel=1e-4)


@EACH_ARCHITECTURE
@EACH_MODEL
def test_a_plan_that_holds_mask_has_infinite_energy(architecture, past):
    for t in range(HORIZON):
        actions = np.array([1, 2, 3])
        actions[t] = MASK
        assert np.isposinf(run(architecture, past, random_context(3, past), actions)["total"])


@EACH_ARCHITECTURE
@EACH_MODEL
def test_the_action_before_masking_is_not_seen(architecture, past):
    context = random_context(4, past)
    for t in range(HORIZON):
        seen, unseen = [], []
        for action in range(ACTIONS):
            actions = np.array([0, 1, 2])
            actions[t] = action
            unseen.append(run(architecture, past, context, actions, t)["conditional"])
            seen.append(run(architecture, past, context, actions, (t + 1) % 3)["conditional"])
        np.testing.assert_array_equal(unseen, np.broadcast_to(unseen[0], (ACTIONS, ACTIONS)))
        # Every other position does see it.
        for other in seen[1:]:
            assert largest_change(other, seen[0]) > 1e-3


@EACH_ARCHITECTURE
@EACH_MODEL
def test_positions_masked_together_see_none_of_each_other(architecture, past):
    context = random_context(5, past)
    blank = run(architecture, past, context, [MASK] * 3)
    expected = -log_softmax(blank["logits"])
    for actions in ([0, 1, 2], [3, END, 0]):
        together = run(architecture, past, context, actions)["together"]
        np.testing.assert_array_equal(together, blank["together"])
        np.testing.assert_allclose(together, expected, rtol=1e-5, atol=1e-5)


@EACH_ARCHITECTURE
@EACH_MODEL
def test_one_queried_position_has_the_logits_of_all(architecture, past):
    context = random_context(6, past)
    for t in range(HORIZON):
        result = run(architecture, past, context, [2, MASK, 0], t)
        np.testing.assert_allclose(result["alone"], result["logits"][t], rtol=1e-5, atol=1e-5)


@EACH_ARCHITECTURE
@EACH_MODEL
def test_what_the_model_must_know_changes_its_logits(architecture, past):
    context = random_context(8, past)
    before = run(architecture, past, context, [0, MASK, 1])["logits"]
    o = context.observation
    other = random_observation(np.random.default_rng(80))
    changes = {
        "grid": other.grid,
        "goal": (o.goal + 1) % SIDE,
        "carried": np.zeros(2, np.int32),
        "instruction": other.instruction,
    }
    for name, value in changes.items():
        changed = context._replace(observation=o._replace(**{name: value}))
        after = run(architecture, past, changed, [0, MASK, 1])["logits"]
        assert largest_change(after, before) > 1e-4, name


def with_kind(context, kind):
    """The same, with objects of one kind everywhere but where the agent is."""
    observation = context.observation
    grid = observation.grid.copy()
    grid[..., 0] = kind
    grid[tuple(observation.pose[:2])] = observation.grid[tuple(observation.pose[:2])]
    return context._replace(observation=observation._replace(grid=grid))


def moved_past(context):
    pose = context.past.pose.copy()
    pose[1, :2] = (pose[1, :2] + 2) % SIDE
    return context._replace(past=context.past._replace(pose=pose))


@EACH_ARCHITECTURE
def test_past_states_are_seen(architecture):
    context = with_kind(random_context(9, 2), BALL)
    before = run(architecture, 2, context, [0, MASK, 1])["logits"]
    after = run(architecture, 2, moved_past(context), [0, MASK, 1])["logits"]
    assert largest_change(after, before) > 1e-4
    swapped = context._replace(past=jax.tree.map(lambda x: x[::-1], context.past))
    after = run(architecture, 2, swapped, [0, MASK, 1])["logits"]
    assert largest_change(after, before) > 1e-4


@EACH_ARCHITECTURE
def test_only_the_papers_model_reads_past_actions(architecture):
    context = random_context(9, 2)
    before = run(architecture, 2, context, [0, MASK, 1])["logits"]
    others = context._replace(actions=(context.actions + 1) % (ACTIONS - 1))
    after = run(architecture, 2, others, [0, MASK, 1])["logits"]
    assert (largest_change(after, before) > 1e-4) == (architecture == "paper")


@pytest.mark.parametrize("kind", [EMPTY, WALL])
def test_ours_remembers_only_what_has_a_name(kind):
    context = with_kind(random_context(9, 2), kind)
    before = run("leapjax", 2, context, [0, MASK, 1])["logits"]
    after = run("leapjax", 2, moved_past(context), [0, MASK, 1])["logits"]
    np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("faced_now", [False, True])
def test_ours_sees_what_the_agent_faces_now_and_forgets_what_was_before_the_start(faced_now):
    context = with_kind(random_context(9, 2), EMPTY)
    x, y, direction = context.observation.pose.tolist()
    assert 0 < x < SIDE - 1 and 0 < y < SIDE - 1
    behind = (direction + 2) % 4
    past = np.tile([x, y, behind], (2, 1)).astype(np.int32)
    context = context._replace(past=context.past._replace(pose=past))
    dx, dy = symmetries.DIRECTION_VECTORS[direction if faced_now else behind]
    context.observation.grid[x + dx, y + dy] = BALL, 2, 0
    begun = context._replace(actions=np.full(2, ACTIONS + 1, np.int32))  # all PAD
    known = run("leapjax", 2, context, [0, MASK, 1])["logits"]
    unknown = run("leapjax", 2, begun, [0, MASK, 1])["logits"]
    if faced_now:  # the past adds nothing to it
        np.testing.assert_array_equal(known, unknown)
    else:
        assert largest_change(known, unknown) > 1e-4


def test_episodes_longer_than_expected_stay_finite():
    context = random_context(10, 2)
    last = run("paper", 2, context._replace(step=np.int32(MAX_STEPS)), [0, 1, 2])["logits"]
    later = run("paper", 2, context._replace(step=np.int32(50 * MAX_STEPS)), [0, 1, 2])["logits"]
    np.testing.assert_array_equal(later, last)
    assert np.isfinite(last[1:]).all()


# Promises of the leapjax architecture.


@pytest.mark.parametrize("padded", [1, 2])
def test_steps_before_the_episode_leak_nothing(padded):
    context = random_context(11, 2)
    actions = context.actions.copy()
    actions[:padded] = PAD
    context = context._replace(actions=actions)
    other = random_context(12, 2).past

    def exchange(mine, others, steps):
        mine = mine.copy()
        mine[steps] = others[steps]
        return mine

    before = run("leapjax", 2, context, [0, MASK, 1])
    before_start = jax.tree.map(lambda a, b: exchange(a, b, slice(padded)), context.past, other)
    after = run("leapjax", 2, context._replace(past=before_start), [0, MASK, 1])
    for name, value in before.items():
        np.testing.assert_array_equal(after[name], value, err_msg=name)
    # The same change in a step that did happen is seen.
    happened = context._replace(actions=np.zeros(2, np.int32))
    before = run("leapjax", 2, happened, [0, MASK, 1])["logits"]
    after = run("leapjax", 2, happened._replace(past=before_start), [0, MASK, 1])["logits"]
    assert largest_change(after, before) > 1e-3


def turn(context, quarters):
    context = jax.tree.map(jnp.asarray, context)
    rotate = functools.partial(symmetries.rotate, quarters=jnp.int32(quarters))
    past = jax.vmap(rotate)(context.past) if len(context.actions) else context.past
    return context._replace(observation=rotate(context.observation), past=past)


@EACH_MODEL
@pytest.mark.parametrize("goal", [True, False])
def test_turning_the_whole_world_changes_no_logits(past, goal):
    context = random_context(13, past, goal)
    before = run("leapjax", past, context, [0, MASK, 1])["logits"]
    for quarters in (1, 2, 3):
        turned = turn(context, quarters)
        assert (np.asarray(turned.observation.pose) != context.observation.pose).any()
        after = run("leapjax", past, turned, [0, MASK, 1])["logits"]
        assert largest_change(after, before) < 1e-5
        # Turning the agent alone is another world.
        pose = context.observation.pose.copy()
        pose[2] = (pose[2] - quarters) % 4
        alone = context._replace(observation=context.observation._replace(pose=pose))
        other = run("leapjax", past, alone, [0, MASK, 1])["logits"]
        assert largest_change(other, before) > 1e-3


# The encoders' building blocks against slow truths.


def test_padding_after_the_instruction_changes_nothing():
    module = encoders.InstructionEncoder(VOCABULARY, 16)
    words = np.array([3, 1, 7], np.int32)
    params = random_parameters(jax.eval_shape(module.init, jax.random.key(0), words))
    encode = quick_jit(lambda p, w: module.apply(p, w).whole)
    before = encode(params, words)
    np.testing.assert_allclose(encode(params, np.append(words, [0, 0])), before, atol=1e-6)
    for other in ([3, 1, 0], [3, 1, 6], [1, 3, 7]):
        assert largest_change(encode(params, np.array(other, np.int32)), before) > 1e-3


def test_min_plus_is_shortest_ways():
    rng = np.random.default_rng(14)
    cost = rng.uniform(0.1, 2.0, size=(SIDE, SIDE)).astype(np.float32)
    start = rng.uniform(0.0, 12.0, size=(SIDE, SIDE)).astype(np.float32)
    # Dijkstra from all cells at once: a way may end anywhere, at that cell's price.
    distance = start.astype(np.float64)
    queue = [(d, cell) for cell, d in np.ndenumerate(distance)]
    heapq.heapify(queue)
    while queue:
        d, (x, y) = heapq.heappop(queue)
        if d > distance[x, y]:
            continue
        for near in ((x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)):
            if min(near) >= 0 and max(near) < SIDE and d + cost[near] < distance[near]:
                distance[near] = d + cost[near]
                heapq.heappush(queue, (distance[near], near))
    far = quick_jit(encoders.min_plus, static_argnums=2)
    actual = far(start[..., None], cost[..., None], SIDE * SIDE)[..., 0]
    np.testing.assert_allclose(actual, distance, rtol=1e-5)
    assert (distance < start - 0.1).mean() > 0.3
    # One sweep carries a distance one cell.
    once = np.asarray(far(start[..., None], cost[..., None], 1)[..., 0])
    padded = np.pad(start, 1, constant_values=np.inf)
    near = np.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    np.testing.assert_allclose(once, np.minimum(start, cost + near.min(0)), rtol=1e-6)


def test_gradient_of_min_plus_is_its_slope():
    rng = np.random.default_rng(0)  # no two ways of nearly equal length
    cost = rng.uniform(0.1, 2.0, size=(3, 3, 1)).astype(np.float32)
    start = rng.uniform(0.0, 6.0, size=(3, 3, 1)).astype(np.float32)
    weight = rng.normal(size=(3, 3, 1)).astype(np.float32)

    def weighted(start, cost):
        return (weight * encoders.min_plus(start, cost, 9)).sum()

    height = quick_jit(weighted)
    gradients = quick_jit(jax.grad(weighted, (0, 1)))(start, cost)
    assert all(np.count_nonzero(gradient) for gradient in gradients)
    for which, gradient in enumerate(gradients):
        for cell in np.ndindex(3, 3, 1):
            up, down = [start.copy(), cost.copy()], [start.copy(), cost.copy()]
            up[which][cell] += 1e-2
            down[which][cell] -= 1e-2
            slope = (height(*up) - height(*down)) / 2e-2
            assert float(gradient[cell]) == pytest.approx(float(slope), abs=2e-3)


@pytest.mark.parametrize(("side", "padding"), [(3, (1, 1)), (2, (1, 1)), (2, (0, 0))])
def test_convolution_is_a_sum_over_neighbours(side, padding):
    rng = np.random.default_rng(15)
    image = rng.normal(size=(SIDE, SIDE, 2)).astype(np.float32)
    module = encoders.Convolution(3, side, padding)
    shapes = jax.eval_shape(module.init, jax.random.key(0), image)
    params = random_parameters(shapes)
    actual = quick_jit(module.apply)(params, image)
    ((_, dense),) = params["params"].items()
    kernel = dense["kernel"].reshape(side, side, 2, 3)
    padded = np.pad(image, (padding, padding, (0, 0)))
    size = SIDE + sum(padding) - side + 1
    expected = np.broadcast_to(dense["bias"], (size, size, 3)).copy()
    for x in range(size):
        for y in range(size):
            for dx in range(side):
                for dy in range(side):
                    expected[x, y] += padded[x + dx, y + dy] @ kernel[dx, dy]
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("position", [(0, 0), (2, 3), (6, 6), (0, 6)])
def test_cells_are_read_where_they_are(position):
    image = np.random.default_rng(16).normal(size=(SIDE, SIDE, 2)).astype(np.float32)
    where = np.array(position)
    np.testing.assert_allclose(encoders.feature_at(image, where), image[position], rtol=1e-6)
    x, y = position
    for radius in (1, 2):
        padded = np.pad(image, ((radius, radius), (radius, radius), (0, 0)))
        expected = padded[x : x + 2 * radius + 1, y : y + 2 * radius + 1].reshape(-1)
        actual = encoders.neighbourhood(image, where, radius)
        np.testing.assert_array_equal(actual, expected)


def test_a_goal_that_is_not_available_is_nowhere():
    assert not np.asarray(encoders.one_cell(np.array([-1, -1]), SIDE)).any()
    image = np.ones((SIDE, SIDE, 2), np.float32)
    np.testing.assert_array_equal(encoders.feature_at(image, np.array([-1, -1])), [0, 0])


# Lower precision.


@EACH_ARCHITECTURE
def test_bfloat16_is_nearly_float32_with_parameters_in_float32(architecture):
    sizes = Sizes(SIDE, VOCABULARY, ACTIONS, 2, HORIZON, MAX_STEPS)
    config = tiny(architecture)
    params, _ = model(architecture, 2)
    context = random_context(0, 2)
    actions = jnp.zeros(HORIZON, jnp.int32)

    def everything(module, context, actions):
        return module.logits(module.encode(context), actions, EVERYWHERE)

    found = {}
    for dtype in ("float32", "bfloat16"):
        module = build(dataclasses.replace(config, dtype=dtype), sizes)
        shapes = jax.eval_shape(
            functools.partial(module.init, method=everything), jax.random.key(0), context, actions
        )
        assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {jnp.dtype("float32")}
        run = jax.jit(functools.partial(module.apply, method=everything))
        found[dtype] = np.asarray(run(params, context, actions))[:, :-1]  # the end may be -inf
        products = re.findall(
            r"stablehlo.dot_general.*-> tensor<[^>]*x(\w+)>",
            run.lower(params, context, actions).as_text(),
        )
        assert products and ("bf16" in products) == (dtype == "bfloat16")
    assert found["bfloat16"].dtype == np.float32
    difference = np.abs(found["bfloat16"] - found["float32"]).max()
    assert 0 < difference < 0.05 * np.abs(found["float32"]).max()


def test_unknown_precision_is_refused():
    with pytest.raises(ValueError, match="unknown dtype 'float16': .* float32, bfloat16"):
        ModelConfig(dtype="float16")


# Mistakes.


def test_unknown_architecture_is_refused():
    with pytest.raises(ValueError, match=r"unknown architecture 'gpt': .* paper, leapjax"):
        ModelConfig(architecture="gpt")


def test_width_that_does_not_split_into_heads_is_refused():
    with pytest.raises(ValueError, match="width 10 is not a multiple of 4 heads"):
        ModelConfig(width=10, heads=4)
