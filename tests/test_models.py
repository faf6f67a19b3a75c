import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.domains.babyai import symmetries, vocabulary
from leapjax.domains.babyai.adapter import END, NUM_ACTIONS
from leapjax.domains.babyai.encoders.context_tokens import ContextTokens
from leapjax.domains.babyai.encoders.state_tokens import StateTokens
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from leapjax.energy import pseudo_likelihood
from leapjax.models.config import ARCHITECTURES, ModelConfig, Sizes
from leapjax.models.lstm import SequenceClassifier
from leapjax.models.masked import build_masked_model
from leapjax.models.transformer import causal_mask
from leapjax.types import Context, mask_token, pad_token
from tests import mixed
from tests.parameters import scaled_like
from tests.programs import only_long
from tests.quick import quick_jit

# In a smaller grid, the pooling and normalisation of the paper's network remove almost all signal.
SIDE = 7
EMPTY, WALL, BALL = 1, 2, 6
ACTIONS, HORIZON, WORDS, MAX_STEPS = NUM_ACTIONS, 3, 4, 20
MASK, PAD = mask_token(ACTIONS), pad_token(ACTIONS)
EVERYWHERE = np.arange(HORIZON)


class Mixing(ContextTokens):
    def place_actions(self, tokens, positions):
        return positions + tokens + jnp.tanh(jnp.roll(tokens, 1, axis=0))


def make_module(kind, architecture, past, dtype="float32"):
    """Makes a tiny BabyAI model; "mixing" is leapjax's with an encoder that mixes actions."""
    mixing = architecture == "mixing"
    architecture = "leapjax" if mixing else architecture
    config = ModelConfig(architecture, 2, 2, width=16, dtype=dtype)
    settings = Settings(channels=8, rounds=1, fields=2, sweeps=5, word_heads=2)
    encoder = {
        "paper": StateTokens(SIDE, config.width, dtype),
        "leapjax": (Mixing if mixing else ContextTokens)(settings, config.width, dtype),
    }[architecture]
    return kind(config, Sizes(ACTIONS, past, HORIZON, MAX_STEPS), encoder)


def use_parameters(module, context, actions):
    """Uses every parameter."""
    return module.logits(module.encode(context), actions, EVERYWHERE)


@functools.cache
def make_model(architecture, past):
    """Makes a tiny model with random parameters: `(params, evaluate)`.

    `evaluate(params, context, actions, position)` compiles once and returns the logits at all
    positions and at one alone, and the total energy.
    """
    module = make_module(build_masked_model, architecture, past)

    def encode(params, context):
        return module.apply(params, context, method="encode")

    def logits(params, memory, actions, positions):
        return module.apply(params, memory, actions, positions, method="logits")

    energy = pseudo_likelihood(encode, logits, ACTIONS)

    @quick_jit
    def evaluate(params, context, actions, position):
        memory = encode(params, context)
        return {
            "logits": logits(params, memory, actions, EVERYWHERE),
            "alone": logits(params, memory, actions, position[None])[0],
            "total": energy.total(params, memory, actions),
        }

    initialise = functools.partial(module.init, method=use_parameters)
    shapes = jax.eval_shape(initialise, jax.random.key(0), random_context(0, past), EVERYWHERE)
    return scaled_like(shapes), evaluate


def random_observation(rng, goal=True):
    grid = np.stack([rng.integers(0, n, (SIDE, SIDE)) for n in (10, 6, 4)], -1).astype(np.uint8)
    x, y, direction = *rng.integers(0, SIDE, 2), rng.integers(0, 4)
    grid[x, y] = symmetries.AGENT, 0, direction
    return Observation(
        grid=grid,
        pose=np.array([x, y, direction], np.int32),
        carried=np.array([rng.integers(5, 8), rng.integers(0, 6)], np.int32),
        goal=(rng.integers(0, SIDE, 2) if goal else np.array([-1, -1])).astype(np.int32),
        instruction=np.append(rng.integers(1, vocabulary.SIZE, WORDS - 1), 0).astype(np.int32),
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
        rewards=rng.normal(size=past).astype(np.float32),
        step=np.int32(past + 3),
        return_so_far=np.float32(rng.normal()),
    )


def run(architecture, past, context, actions, position=0):
    params, evaluate = make_model(architecture, past)
    results = evaluate(params, context, np.asarray(actions, np.int32), np.int32(position))
    return {name: np.asarray(value) for name, value in results.items()}


def largest_change(after, before):
    """Returns the largest change of the finite logits."""
    finite = np.isfinite(before)
    np.testing.assert_array_equal(np.isfinite(after), finite)
    return np.abs(after[finite] - before[finite]).max()


# Each pair of architecture and past length has one program, which all its tests share.
NETWORKS = [
    *((architecture, 2) for architecture in ARCHITECTURES), ("mixing", 0),
    *(pytest.param(architecture, 0, marks=only_long) for architecture in ARCHITECTURES),
]  # fmt: skip
EACH_ARCHITECTURE = pytest.mark.parametrize("architecture", ARCHITECTURES)
EACH_NETWORK = pytest.mark.parametrize(("architecture", "past"), NETWORKS)


@EACH_NETWORK
def test_end_is_forbidden_at_the_first_position_only(architecture, past):
    context = random_context(0, past)
    forbidden = np.arange(HORIZON * ACTIONS).reshape(HORIZON, ACTIONS) == END
    for actions in ([MASK] * 3, [0, 1, 2], [END] * 3):
        output = run(architecture, past, context, actions)
        np.testing.assert_array_equal(np.isneginf(output["logits"]), forbidden)
        assert np.isfinite(output["logits"][~forbidden]).all()
        assert np.isfinite(output["total"]) == (actions == [0, 1, 2])


@EACH_NETWORK
def test_logits_do_not_depend_on_the_queried_positions(architecture, past):
    context = random_context(6, past)
    for t in range(HORIZON):
        result = run(architecture, past, context, [2, MASK, 0], t)
        np.testing.assert_allclose(result["alone"], result["logits"][t], rtol=1e-5, atol=1e-5)


@EACH_NETWORK
def test_every_field_of_an_observation_changes_the_logits(architecture, past):
    context = random_context(8, past)
    before = run(architecture, past, context, [0, MASK, 1])["logits"]
    o, other = context.observation, random_observation(np.random.default_rng(80))
    for name, value in {
        "grid": other.grid,
        "goal": (o.goal + 1) % SIDE,
        "carried": np.zeros(2, np.int32),
        "instruction": other.instruction,
    }.items():
        changed = context._replace(observation=o._replace(**{name: value}))
        after = run(architecture, past, changed, [0, MASK, 1])["logits"]
        assert largest_change(after, before) > 1e-4, name


def fill_grid(context, kind):
    """Fills every cell but the agent's with objects of one kind."""
    observation = context.observation
    grid = observation.grid.copy()
    grid[..., 0] = kind
    grid[tuple(observation.pose[:2])] = observation.grid[tuple(observation.pose[:2])]
    return context._replace(observation=observation._replace(grid=grid))


def move_past(context):
    pose = context.past.pose.copy()
    pose[1, :2] = (pose[1, :2] + 2) % SIDE
    return context._replace(past=context.past._replace(pose=pose))


@EACH_ARCHITECTURE
def test_past_states_change_the_logits_and_rewards_do_not(architecture):
    """Only the paper's model reads past actions."""
    context = fill_grid(random_context(9, 2), BALL)
    before = run(architecture, 2, context, [0, MASK, 1])["logits"]
    swapped = jax.tree.map(lambda x: x[::-1], context.past)
    acted = (context.actions + 1) % (ACTIONS - 1)
    rewarded = {"rewards": context.rewards + 1, "return_so_far": np.float32(-5)}
    for after, seen in [
        (move_past(context), True),
        (context._replace(past=swapped), True),
        (context._replace(actions=acted), architecture == "paper"),
        (context._replace(**rewarded), False),
    ]:
        change = largest_change(run(architecture, 2, after, [0, MASK, 1])["logits"], before)
        assert change > 1e-4 if seen else change == 0


@pytest.mark.parametrize("kind", [EMPTY, WALL])
def test_leapjax_model_does_not_remember_empty_cells_and_walls(kind):
    context = fill_grid(random_context(9, 2), kind)
    before = run("leapjax", 2, context, [0, MASK, 1])["logits"]
    after = run("leapjax", 2, move_past(context), [0, MASK, 1])["logits"]
    np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("faced_now", [False, True])
def test_leapjax_model_remembers_faced_objects_of_the_episode_only(faced_now):
    context = fill_grid(random_context(9, 2), EMPTY)
    x, y, direction = context.observation.pose.tolist()
    assert 0 < x < SIDE - 1 and 0 < y < SIDE - 1
    behind = (direction + 2) % 4
    past = np.tile([x, y, behind], (2, 1)).astype(np.int32)
    context = context._replace(past=context.past._replace(pose=past))
    dx, dy = symmetries.DIRECTION_VECTORS[direction if faced_now else behind]
    context.observation.grid[x + dx, y + dy] = BALL, 2, 0
    starting = context._replace(actions=np.full(2, PAD, np.int32))
    known = run("leapjax", 2, context, [0, MASK, 1])["logits"]
    unknown = run("leapjax", 2, starting, [0, MASK, 1])["logits"]
    if faced_now:  # the past adds no information
        np.testing.assert_array_equal(known, unknown)
    else:
        assert largest_change(known, unknown) > 1e-4


def test_logits_stay_finite_after_max_steps():
    context = random_context(10, 2)
    last = run("paper", 2, context._replace(step=np.int32(MAX_STEPS)), [0, 1, 2])["logits"]
    later = run("paper", 2, context._replace(step=np.int32(50 * MAX_STEPS)), [0, 1, 2])["logits"]
    np.testing.assert_array_equal(later, last)
    assert np.isfinite(last[1:]).all()


@pytest.mark.parametrize("padded", [1, 2])
def test_steps_before_the_episode_do_not_change_the_logits(padded):
    context, other = random_context(11, 2), random_context(12, 2).past

    def exchange(mine, others):
        return np.concatenate([others[:padded], mine[padded:]])

    exchanged = jax.tree.map(exchange, context.past, other)
    for past_action in (PAD, 0):  # a step before the episode, and one in it
        actions = exchange(context.actions, np.full(2, past_action, np.int32))
        before = context._replace(actions=actions)
        after = before._replace(past=exchanged)
        before, after = (run("leapjax", 2, c, [0, MASK, 1])["logits"] for c in (before, after))
        change = largest_change(after, before)
        assert change == 0 if past_action == PAD else change > 1e-3


@quick_jit
def rotate_context(context, quarters):
    """Rotates every state of a context by quarter turns."""
    past = jax.vmap(symmetries.rotate, (0, None))(context.past, quarters)
    return context._replace(observation=symmetries.rotate(context.observation, quarters), past=past)


@pytest.mark.parametrize("goal", [True, False])
def test_rotating_the_whole_world_keeps_the_logits(goal):
    context = random_context(13, 2, goal)
    before = run("leapjax", 2, context, [0, MASK, 1])["logits"]
    for quarters in (1, 2, 3):
        turned = rotate_context(context, quarters)
        after = run("leapjax", 2, turned, [0, MASK, 1])["logits"]
        assert largest_change(after, before) < 1e-5
        # Rotating only the agent changes the logits.
        pose = context.observation.pose - np.array([0, 0, quarters], np.int32)
        pose[2] %= 4
        alone = context._replace(observation=context.observation._replace(pose=pose))
        other = run("leapjax", 2, alone, [0, MASK, 1])["logits"]
        assert largest_change(other, before) > 1e-3


@EACH_ARCHITECTURE
def test_bfloat16_logits_are_close_to_float32_with_float32_parameters(architecture):
    params, _ = make_model(architecture, 2)
    context, actions = random_context(0, 2), np.zeros(HORIZON, np.int32)
    module = make_module(build_masked_model, architecture, 2, "bfloat16")
    init = functools.partial(module.init, method=use_parameters)
    shapes = jax.eval_shape(init, jax.random.key(0), context, actions)
    assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {jnp.dtype("float32")}
    scores = quick_jit(functools.partial(module.apply, method=use_parameters))
    program = scores.lower(params, context, actions)
    assert re.search(r"stablehlo.dot_general.*-> tensor<[^>]*xbf16>", program.as_text())
    low = np.asarray(program.compile()(params, context, actions))[:, :-1]
    high = run(architecture, 2, context, actions)["logits"][:, :-1]  # the end may be -inf
    assert low.dtype == np.float32
    assert 0 < np.abs(low - high).max() < 0.05 * np.abs(high).max()


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_causal_attention_hides_later_actions(architecture):
    """With full attention, every action sees all others."""
    zero_actions = np.zeros(HORIZON, np.int32)
    context = jax.tree.map(lambda leaf: np.asarray(leaf)[0], mixed.contexts(1))
    everywhere = np.ones((HORIZON, HORIZON), bool)
    for attention, visible in {"causal": np.tril(everywhere), "full": everywhere}.items():
        config = ModelConfig(architecture, 2, 2, 16, attention=attention)
        encoder = mixed.DOMAIN.encoders[architecture](config, 1)
        module = build_masked_model(config, Sizes(4, 1, HORIZON, 9), encoder)
        apply = functools.partial(module.apply, method=use_parameters)
        init = functools.partial(module.init, method=use_parameters)
        params = scaled_like(jax.eval_shape(init, jax.random.key(0), context, zero_actions))
        scores = quick_jit(functools.partial(apply, params))
        before = scores(context, zero_actions)
        for changed in range(HORIZON):
            after = scores(context, (np.arange(HORIZON) == changed).astype(np.int32))
            seen = visible[:, changed].copy()
            # leapjax reads logits at the (masked) action, the paper's network before it.
            seen[changed] &= architecture == "leapjax" or attention == "full"
            differs = np.abs(after - before)[:, :3].max(axis=1) > 1e-7
            np.testing.assert_array_equal(differs, seen)


@pytest.mark.parametrize("past", [0, 2])
def test_causal_attention_with_a_cached_context_equals_attention_over_all_tokens(past):
    """The paper's network, conditioned on returns, keeps all tokens under full attention."""
    encoder = mixed.DOMAIN.encoders["paper"](ModelConfig("paper", 2, 2, 16), past)
    configs = [ModelConfig("paper", 2, 2, 16, attention=each) for each in ("causal", "full")]
    module, full = (
        build_masked_model(each, Sizes(4, past, HORIZON, 9), encoder, True) for each in configs
    )
    context = jax.tree.map(lambda leaf: np.asarray(leaf)[0], mixed.contexts(past))
    returns = np.arange(past + 1, dtype=np.float32)
    actions, positions = np.array([1, mask_token(4), 2]), np.array([2, 0])

    def scores(module, actions):
        return module.logits(module.encode(context, returns=returns), actions, positions)

    def score_all_tokens(module, actions):
        prefix, tokens = module.encode(context, returns=returns)
        assert prefix is None and len(tokens) == 3 * (past + HORIZON)
        queried = 3 * (past + np.arange(HORIZON)) + 1
        x = tokens.at[queried + 1].add(jnp.tanh(module.action(actions)))
        return module.head(module.transformer(x, queried[positions], mask=causal_mask(len(x))))

    initialise = functools.partial(module.init, method=scores)
    params = scaled_like(jax.eval_shape(initialise, jax.random.key(0), actions))
    output = quick_jit(functools.partial(module.apply, method=scores))(params, actions)
    reference = quick_jit(functools.partial(full.apply, method=score_all_tokens))(params, actions)
    assert np.ptp(reference[0]) > 1e-4
    # The end action is never first.
    np.testing.assert_allclose(output[0], reference[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(output[1, :-1], reference[1, :-1], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("past", "repeat_state"), [(2, False), (0, True)])
def test_repeat_state_shows_the_current_state_at_later_positions(past, repeat_state):
    """Later positions show the current state (equation 3), or its part without the pose."""
    encoder = StateTokens(SIDE, 16)
    sizes = Sizes(ACTIONS, past, HORIZON, MAX_STEPS)
    module = build_masked_model(
        ModelConfig("paper", 1, 2, 16), sizes, encoder, repeat_state=repeat_state
    )
    here = random_context(0, past)
    initialise = functools.partial(module.init, method=use_parameters)
    params = scaled_like(jax.eval_shape(initialise, jax.random.key(0), here, EVERYWHERE))
    params["params"]["position"]["embedding"][:] = 0  # tokens differ only by content
    encode = quick_jit(functools.partial(module.apply, method="encode"))

    def states(context):
        return np.asarray(encode(params, context).tokens)[::2][past:]

    def differ(**changes):
        there = here._replace(observation=here.observation._replace(**changes))
        return np.abs(states(there) - states(here)).max(axis=1) > 1e-4

    now, *later = states(here)
    for each in later:
        np.testing.assert_array_equal(each, later[0])
    assert (np.abs(later[0] - now).max() > 1e-4) == (not repeat_state)

    assert differ(pose=(here.observation.pose + 1) % 4).tolist() == [True] + [repeat_state] * 2
    assert differ(goal=(here.observation.goal + 1) % SIDE).all()
    assert differ(grid=here.observation.grid[::-1].copy()).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dtype": "float16"}, "unknown dtype 'float16': .* float32, bfloat16"),
        ({"architecture": "gpt"}, "unknown architecture 'gpt': .* paper, leapjax"),
        ({"width": 10, "heads": 4}, "width 10 is not a multiple of 4 heads"),
    ],
)
def test_invalid_settings_raise_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        ModelConfig(**options)


def find_degree(module, context, actions):
    return module.degree(module.encode(context), actions)


@pytest.mark.parametrize(
    ("kind", "method"), [(build_masked_model, use_parameters), (SequenceClassifier, find_degree)]
)
@EACH_ARCHITECTURE
def test_plans_of_another_length_raise_an_error(kind, method, architecture):
    init = functools.partial(make_module(kind, architecture, 0).init, method=method)
    context = random_context(0, 0)
    for horizon in (HORIZON - 1, HORIZON + 1):
        with pytest.raises(ValueError, match=rf"shape \({horizon},\): .* was made for \(3,\)"):
            jax.eval_shape(init, jax.random.key(0), context, np.zeros(horizon, np.int32))
