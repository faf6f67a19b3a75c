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
from leapjax.errors import UserError
from leapjax.models.trajectory import (
    ARCHITECTURES,
    ModelConfig,
    SequenceClassifier,
    Sizes,
    build,
)
from leapjax.models.transformer import causal_mask
from leapjax.types import Context, mask_token, pad_token
from tests import mixed
from tests.enumerable import all_plans
from tests.parameters import scaled_like
from tests.programs import only_long
from tests.quick import quick_jit

# Of a smaller grid, pooling and normalisation leave the paper's network next to nothing.
SIDE = 7
EMPTY, WALL, BALL = 1, 2, 6
ACTIONS, HORIZON, WORDS, MAX_STEPS = NUM_ACTIONS, 3, 4, 20
MASK, PAD = mask_token(ACTIONS), pad_token(ACTIONS)
EVERYWHERE = np.arange(HORIZON)


def make(kind, architecture, past, dtype="float32"):
    """A tiny model of BabyAI's states; "neighbours" is ours with that option."""
    neighbours = architecture == "neighbours"
    architecture = "leapjax" if neighbours else architecture
    config = ModelConfig(architecture, 2, 2, width=16, dtype=dtype, neighbours=neighbours)
    settings = Settings(channels=8, rounds=1, fields=2, sweeps=5, word_heads=2)
    encoder = {
        "paper": StateTokens(SIDE, config.width, dtype),
        "leapjax": ContextTokens(settings, config.width, dtype),
    }[architecture]
    return kind(config, Sizes(ACTIONS, past, HORIZON, MAX_STEPS), encoder)


def everything(module, context, actions):
    """What touches every parameter."""
    return module.logits(module.encode(context), actions, EVERYWHERE)


@functools.cache
def model(architecture, past):
    """A tiny model with random parameters: `(params, evaluate)`.

    `evaluate(params, context, actions, position)` compiles once and returns the logits of
    the actions as they are, at all positions and at one alone; the energies of the
    conditional at one position and at all positions masked together; and the total energy.
    """
    module = make(build, architecture, past)

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
            "conditional": energy.conditional(params, memory, actions, position[None])[0],
            "together": energy.conditional(params, memory, actions, EVERYWHERE),
            "total": energy.total(params, memory, actions),
        }

    shapes = jax.eval_shape(
        functools.partial(module.init, method=everything),
        jax.random.key(0),
        random_context(0, past),
        np.zeros(HORIZON, np.int32),
    )
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


# A program for each pair of architecture and length of the past, which all tests of it share.
MODELS = [
    *((architecture, 2) for architecture in ARCHITECTURES),
    *(pytest.param(architecture, 0, marks=only_long) for architecture in ARCHITECTURES),
]
NETWORKS = [*MODELS, ("neighbours", 0), pytest.param("neighbours", 2, marks=only_long)]
EACH_ARCHITECTURE = pytest.mark.parametrize("architecture", ARCHITECTURES)
EACH_MODEL = pytest.mark.parametrize(("architecture", "past"), MODELS)
EACH_NETWORK = pytest.mark.parametrize(("architecture", "past"), NETWORKS)


# What holds for both architectures.


@EACH_MODEL
def test_end_is_forbidden_at_the_first_position_only(architecture, past):
    context = random_context(0, past)
    for actions in ([MASK] * 3, [0, 1, 2], [END] * 3):
        logits = run(architecture, past, context, actions)["logits"]
        expected = np.zeros((HORIZON, ACTIONS), bool)
        expected[0, END] = True
        np.testing.assert_array_equal(np.isneginf(logits), expected)
        assert np.isfinite(logits[~expected]).all()


@EACH_MODEL
def test_only_plans_that_end_at_once_have_infinite_energy(architecture, past):
    context = random_context(1, past)
    for actions in all_plans(HORIZON, ACTIONS)[:: 20 if past else 9]:
        total = run(architecture, past, context, actions)["total"]
        assert np.isposinf(total) if actions[0] == END else np.isfinite(total)


@EACH_NETWORK
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


@EACH_MODEL
def test_a_plan_that_holds_mask_has_infinite_energy(architecture, past):
    for t in range(HORIZON):
        actions = np.array([1, 2, 3])
        actions[t] = MASK
        assert np.isposinf(run(architecture, past, random_context(3, past), actions)["total"])


@EACH_NETWORK
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


@EACH_NETWORK
def test_positions_masked_together_see_none_of_each_other(architecture, past):
    context = random_context(5, past)
    blank = run(architecture, past, context, [MASK] * 3)
    expected = -log_softmax(blank["logits"])
    for actions in ([0, 1, 2], [3, END, 0]):
        together = run(architecture, past, context, actions)["together"]
        np.testing.assert_array_equal(together, blank["together"])
        np.testing.assert_allclose(together, expected, rtol=1e-5, atol=1e-5)


@EACH_NETWORK
def test_one_queried_position_has_the_logits_of_all(architecture, past):
    context = random_context(6, past)
    for t in range(HORIZON):
        result = run(architecture, past, context, [2, MASK, 0], t)
        np.testing.assert_allclose(result["alone"], result["logits"][t], rtol=1e-5, atol=1e-5)


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


@EACH_ARCHITECTURE
def test_rewards_are_not_read(architecture):
    context = random_context(9, 2)
    others = context._replace(rewards=context.rewards + 1, return_so_far=np.float32(-5))
    before, after = (run(architecture, 2, c, [0, MASK, 1]) for c in (context, others))
    jax.tree.map(np.testing.assert_array_equal, after, before)


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
    begun = context._replace(actions=np.full(2, PAD, np.int32))
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
    """Every state of a context, seen after so many quarter turns."""
    rotate = _rotations(len(context.actions))
    observation, past = rotate(context.observation, context.past, quarters)
    return context._replace(observation=observation, past=past)


@functools.cache
def _rotations(past):
    each = jax.vmap(symmetries.rotate, (0, None))

    @quick_jit
    def rotate(observation, states, quarters):
        turned = each(states, quarters) if past else states
        return symmetries.rotate(observation, quarters), turned

    return rotate


@pytest.mark.parametrize("past", [2, pytest.param(0, marks=only_long)])
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


# Lower precision.


@EACH_ARCHITECTURE
def test_bfloat16_is_nearly_float32_with_parameters_in_float32(architecture):
    params, _ = model(architecture, 2)
    context = random_context(0, 2)
    actions = jnp.zeros(HORIZON, jnp.int32)
    programs = {}
    for dtype in ("float32", "bfloat16"):
        module = make(build, architecture, 2, dtype)
        shapes = jax.eval_shape(
            functools.partial(module.init, method=everything), jax.random.key(0), context, actions
        )
        assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {jnp.dtype("float32")}
        scores = quick_jit(functools.partial(module.apply, method=everything))
        programs[dtype] = scores.lower(params, context, actions)
        pattern = r"stablehlo.dot_general.*-> tensor<[^>]*x(\w+)>"
        products = re.findall(pattern, programs[dtype].as_text())
        assert products and ("bf16" in products) == (dtype == "bfloat16")
    low = np.asarray(programs["bfloat16"].compile()(params, context, actions))[:, :-1]
    high = run(architecture, 2, context, actions)["logits"][:, :-1]  # the end may be -inf
    assert low.dtype == np.float32
    assert 0 < np.abs(low - high).max() < 0.05 * np.abs(high).max()


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_with_causal_attention_no_action_sees_a_later_one(architecture):
    """And with full attention every action sees every other."""

    nothing = np.zeros(HORIZON, np.int32)
    context = jax.tree.map(lambda leaf: np.asarray(leaf)[0], mixed.contexts(1))
    everywhere = np.ones((HORIZON, HORIZON), bool)
    for attention, sees in {"causal": np.tril(everywhere), "full": everywhere}.items():
        config = ModelConfig(architecture, 2, 2, 16, attention=attention)
        encoder = mixed.DOMAIN.encoders[architecture](config, 1)
        module = build(config, Sizes(4, 1, HORIZON, 9), encoder)
        apply = functools.partial(module.apply, method=everything)
        init = functools.partial(module.init, method=everything)
        params = scaled_like(jax.eval_shape(init, jax.random.key(0), context, nothing))
        scores = quick_jit(functools.partial(apply, params))
        before = scores(context, nothing)
        for changed in range(HORIZON):
            after = scores(context, (np.arange(HORIZON) == changed).astype(np.int32))
            seen = sees[:, changed].copy()
            # Ours is read where the action is (it is masked there), the paper's before it.
            seen[changed] &= architecture == "leapjax" or attention == "full"
            differs = np.abs(after - before)[:, :3].max(axis=1) > 1e-7
            np.testing.assert_array_equal(differs, seen)


def test_a_token_holds_the_actions_beside_it_and_no_other():
    params, _ = model("neighbours", 0)
    module = make(build, "neighbours", 0)
    tokens = quick_jit(functools.partial(module.apply, params, method="_tokens"))
    own = params["params"]
    table, before, after = (
        own["action"]["embedding"], own["before"]["kernel"], own["after"]["kernel"],
    )  # fmt: skip
    first, middle, last = table[np.array([2, MASK, 5])]
    expected = [first + middle @ after, middle + first @ before + last @ after]
    expected.append(last + middle @ before)
    np.testing.assert_allclose(tokens(np.array([2, MASK, 5])), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("past", [0, 2])
def test_causal_attention_over_a_kept_context_is_that_over_all_tokens(past):
    """The paper's network, conditioned on returns; with full attention it keeps all tokens."""
    encoder = mixed.DOMAIN.encoders["paper"](ModelConfig("paper", 2, 2, 16), past)
    configs = [ModelConfig("paper", 2, 2, 16, attention=each) for each in ("causal", "full")]
    module, full = (build(each, Sizes(4, past, HORIZON, 9), encoder, True) for each in configs)
    context = jax.tree.map(lambda leaf: np.asarray(leaf)[0], mixed.contexts(past))
    returns = np.arange(past + 1, dtype=np.float32)
    actions, positions = np.array([1, mask_token(4), 2]), np.array([2, 0])

    def scores(module, actions):
        return module.logits(module.encode(context, returns=returns), actions, positions)

    def over_all(module, actions):
        prefix, tokens = module.encode(context, returns=returns)
        assert prefix is None and len(tokens) == 3 * (past + HORIZON)
        asked = 3 * (past + np.arange(HORIZON)) + 1
        x = tokens.at[asked + 1].add(jnp.tanh(module.action(actions)))
        return module.head(module.transformer(x, asked[positions], mask=causal_mask(len(x))))

    initialise = functools.partial(module.init, method=scores)
    params = scaled_like(jax.eval_shape(initialise, jax.random.key(0), actions))
    found = quick_jit(functools.partial(module.apply, method=scores))(params, actions)
    wanted = quick_jit(functools.partial(full.apply, method=over_all))(params, actions)
    assert np.ptp(wanted[0]) > 1e-4
    # The end is never first.
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found[1, :-1], wanted[1, :-1], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("past", "repeat_state"),
    [
        (2, False),
        (0, True),
        pytest.param(0, False, marks=only_long),
        pytest.param(2, True, marks=only_long),
    ],
)
def test_what_a_plan_is_told_of_its_later_states(past, repeat_state):
    """The current one, as equation 4 has it; or what does not depend on where the agent is."""
    encoder = StateTokens(SIDE, 16)
    sizes = Sizes(ACTIONS, past, HORIZON, MAX_STEPS)
    module = build(ModelConfig("paper", 1, 2, 16), sizes, encoder, repeat_state=repeat_state)
    here = random_context(0, past)
    initialise = functools.partial(module.init, method=everything)
    params = scaled_like(jax.eval_shape(initialise, jax.random.key(0), here, EVERYWHERE))
    params["params"]["position"]["embedding"][:] = 0  # tokens differ by what they show alone
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


def test_where_embeddings_of_the_paper_start():
    encoder = StateTokens(SIDE, 64)

    @quick_jit
    def tables(key):
        params = encoder.init(key, random_context(0, 0))["params"]
        leaves = jax.tree.leaves_with_path(params)
        return [leaf for path, leaf in leaves if path[-1].key == "embedding"]

    begun = tables(jax.random.key(0))
    assert len(begun) == 5  # words, coordinates, directions, and the two of what is carried
    for table in begun:
        np.testing.assert_allclose(np.std(table), 1, rtol=0.15)


def test_only_some_encoders_know_no_pose():
    encoder = mixed.DOMAIN.encoders["paper"](ModelConfig("paper", 2, 2, 16), 0)
    with pytest.raises(UserError, match="not repeated are for architecture 'paper' on BabyAI"):
        build(ModelConfig("paper"), Sizes(4, 0, HORIZON, 9), encoder, repeat_state=False)


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


@pytest.mark.parametrize(
    "options", [{"architecture": "paper"}, {"architecture": "leapjax", "attention": "causal"}]
)
def test_a_token_that_would_hold_what_it_may_not_see_is_refused(options):
    with pytest.raises(
        ValueError, match="neighbours needs architecture 'leapjax', .* and attention 'full'"
    ):
        ModelConfig(**options, neighbours=True)


def judge(module, context, actions):
    return module.degree(module.encode(context), actions)


@pytest.mark.parametrize(("kind", "method"), [(build, everything), (SequenceClassifier, judge)])
@EACH_ARCHITECTURE
def test_plans_of_another_length_are_refused(kind, method, architecture):
    module = make(kind, architecture, 0)
    init = functools.partial(module.init, method=method)

    def parameters(horizon):
        actions = np.zeros(horizon, np.int32)
        return jax.eval_shape(init, jax.random.key(0), random_context(0, 0), actions)

    assert parameters(HORIZON)
    for horizon in (HORIZON - 1, HORIZON + 1):
        with pytest.raises(ValueError, match=rf"shape \({horizon},\): .* was made for \(3,\)"):
            parameters(horizon)
