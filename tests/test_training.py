import dataclasses
import functools
import itertools
import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from leapjax import schedules, sharding, training
from leapjax.agents import leap
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.agents.batches import make_blank_steps, window_batches
from leapjax.agents.optimizer import make_optimizer, mask_decayed_parameters
from leapjax.agents.update import make_update
from leapjax.checkpoints import Checkpoints
from leapjax.data import windows
from leapjax.domain import blank_context
from leapjax.domains.babyai import encoders
from leapjax.domains.babyai.adapter import NUM_ACTIONS
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.settings import Settings
from leapjax.errors import UserError
from leapjax.models import trajectory
from leapjax.models.trajectory import ModelConfig
from leapjax.training import NonFiniteLoss
from leapjax.types import Agent, TrainState
from tests import toy
from tests.programs import only_long
from tests.quick import quick_jit

MODEL = ModelConfig(layers=1, heads=2, width=16)
EXACT = dataclasses.replace(MODEL, dropout=0.0)
TRAINING = TrainingConfig(steps=250, batch=16, warmup=20, learning_rate=1e-2)
LEVEL = BABYAI.make("GoToLocalS7N5", Settings(channels=4, rounds=1, sweeps=2, fields=2))


def setup(domain=toy.DOMAIN, model=MODEL, training=TRAINING) -> Setup:
    return Setup(domain, 0, 4, model, training, leap.Settings())


@functools.cache
def tiny() -> tuple[Agent, object]:
    """An agent and its train step, compiled once for all tests."""
    agent = leap.make_agent(setup())
    return agent._replace(init=quick_jit(agent.init)), training.make_train_step(agent)


@pytest.fixture(scope="module")
def data():
    return jax.tree.map(jnp.asarray, windows.concatenate(toy.demonstrations()))


def ignore(step, state, means):
    pass


def assert_identical(a, b) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


def test_a_run_that_is_stopped_and_continued_is_the_run_that_was_not(data, tmp_path):
    agent, step = tiny()
    key = jax.random.key(7)
    whole = training.train(step, agent.init(jax.random.key(0)), data, key, 6, ignore)
    assert int(whole.step) == 6

    first = training.train(step, agent.init(jax.random.key(0)), data, key, 3, ignore)
    saved = Checkpoints(tmp_path / "checkpoints")
    saved.save(first)
    saved.close()
    reopened = Checkpoints(tmp_path / "checkpoints")
    assert reopened.latest == 3
    restored = reopened.restore(agent.init(jax.random.key(1)))
    reopened.close()
    assert_identical(restored, first)
    second = training.train(step, restored, data, key, 6, ignore)
    assert_identical(second, whole)

    other = training.train(step, agent.init(jax.random.key(0)), data, jax.random.key(8), 6, ignore)
    differences = jax.tree.map(lambda a, b: not np.array_equal(a, b), other.params, whole.params)
    assert any(jax.tree.leaves(differences))


def recording_agent() -> Agent:
    """Learns nothing, but reports the batch and the key that it was given."""

    def init(key):
        return TrainState({"w": jnp.zeros(3)}, (), jnp.int32(0))

    def update(state, batch, key):
        params = jax.tree.map(lambda w: w + jax.random.normal(key, w.shape), state.params)
        metrics = {"loss": jnp.zeros(()), "batch": batch, "key": jax.random.key_data(key)}
        return TrainState(params, (), state.step + 1), metrics

    return Agent(init, window_batches(setup()), update, None)


def test_batch_k_is_a_function_of_the_key_and_k(data):
    agent = recording_agent()
    step = training.make_train_step(agent)
    key = jax.random.key(3)

    def at(k: int, weight: float = 0.0, key=key):
        state = TrainState({"w": jnp.full(3, weight)}, (), jnp.int32(k))
        return step(state, data, key)[1]

    shapes = jax.tree.map(jnp.shape, at(0)["batch"])
    assert shapes.actions == (16, 4)
    assert shapes.context.observation == (16, 3)
    assert shapes.context.past == (16, 0, 3)

    state, seen = agent.init(key), []
    for k in range(4):
        state, metrics = step(state, data, key)
        assert int(state.step) == k + 1
        seen.append(metrics)
    # In any order and whatever the parameters are.
    for k in (3, 0, 2, 1):
        assert_identical(at(k, weight=float(k)), seen[k])

    def fingerprint(metrics) -> tuple[bytes, bytes]:
        leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(metrics["batch"])]
        return b"".join(leaves), np.asarray(metrics["key"]).tobytes()

    others = [at(0, key=jax.random.key(4)), at(1000)]
    for prints in zip(*map(fingerprint, [*seen, *others]), strict=True):
        assert len(set(prints)) == 6  # no two batches and no two keys are the same
    # Nor does the update's noise come from the key that drew the batch.
    batch_key = jax.random.fold_in(jax.random.fold_in(key, training.BATCH_STREAM), 0)
    assert not np.array_equal(seen[0]["key"], jax.random.key_data(batch_key))


def test_the_last_augmentation_comes_first_and_each_has_its_own_keys(data):
    def noted(key, window):
        return window._replace(extras=(*window.extras, jax.random.uniform(key)))

    def doubled(key, window):
        window = noted(key, window)
        return window._replace(actions=2 * window.actions)

    def shifted(key, window):
        window = noted(key, window)
        return window._replace(actions=window.actions + 1)

    def draw(*augmentations):
        domain = toy.DOMAIN._replace(augmentations=augmentations)
        return jax.jit(window_batches(setup(domain)))(jax.random.key(0), data)

    first, second = draw(doubled, shifted), draw(shifted, doubled)
    original = (second.actions - 1) // 2
    np.testing.assert_array_equal(first.actions, 2 * (original + 1))
    assert ((original >= 0) & (original <= toy.END)).all()
    assert len(np.unique(np.stack(first.extras))) == 2 * TRAINING.batch


@pytest.mark.parametrize(
    ("masking", "end"),
    [
        ("each", False),
        ("all", False),
        ("random", True),
        pytest.param("each", True, marks=only_long),
    ],
)
def test_the_loss_is_the_energy_of_what_is_masked(masking, end, data, monkeypatch):
    """Equation 1, one position at a time; without an end action PAD is seen, not predicted."""
    made = setup(model=EXACT)._replace(settings=leap.Settings(masking, end))
    agent, horizon = leap.make_agent(made), made.horizon
    compiled, step = tiny()
    state = compiled.init(jax.random.key(0))
    masks, sample = [], schedules.sample_masks

    def remember(key, *rest):
        found = sample(key, *rest)
        jax.debug.callback(lambda mask: masks.append(np.asarray(mask)), found)
        return found

    monkeypatch.setattr(schedules, "sample_masks", remember)
    update, total_energy = quick_jit(agent.update), quick_jit(agent.energy.total)
    energy, pad = agent.energy, toy.DOMAIN.num_actions + 1

    @jax.jit
    def negative_log_likelihoods(context, actions, masked):
        memory = energy.encode(state.params, context)

        def at(position):  # the others that are masked too, and what is known
            tokens = jnp.where(masked, pad - 1, actions)
            energies = energy.conditional(state.params, memory, tokens, position[None])[0]
            return energies[actions[position]] + jax.nn.logsumexp(-energies)

        return jax.lax.map(at, jnp.arange(horizon))

    batch = step.draw(jax.random.key(1), 0, data)
    ended = 0
    for row in range(3):
        one = jax.tree.map(lambda leaf, r=row: leaf[r : r + 1], batch)
        imitated = np.arange(horizon) >= row  # what comes before is shown, and not learned
        one = one._replace(imitated=jnp.asarray(imitated)[None])
        _, metrics = update(state, one, jax.random.key(row))
        jax.effects_barrier()
        (drawn,) = masks[-1:]
        beyond = np.asarray(one.actions[0] == toy.END) & (not end)
        ended += beyond.sum()
        tokens = jnp.where(beyond, pad, one.actions[0])
        context = jax.tree.map(lambda leaf: leaf[0], one.context)
        total = 0.0
        for masked in drawn.reshape(-1, horizon):
            masked = masked & imitated
            each = negative_log_likelihoods(context, tokens, masked)
            total += float(jnp.where(masked & ~beyond, each, 0).sum())
        assert float(metrics["loss"]) == pytest.approx(total / drawn.sum(), rel=1e-4)
        if (masking, end, row) == ("each", True, 0):  # the energy of a plan, over T
            memory = quick_jit(energy.encode)(state.params, context)
            whole = float(total_energy(state.params, memory, one.actions[0]))
            assert whole == pytest.approx(total, rel=1e-4)
    assert ended > 0 or end


def test_without_an_end_action_no_plan_ends():
    made = setup()._replace(settings=leap.Settings("each", end=False))
    energy, params = leap.make_agent(made).energy, tiny()[0].init(jax.random.key(0)).params
    memory = quick_jit(energy.encode)(params, blank_context(toy.DOMAIN, 0))
    mask = np.full(4, toy.DOMAIN.num_actions)
    energies = np.asarray(quick_jit(energy.conditional)(params, memory, mask, np.arange(4)))
    assert (energies[:, toy.END] == np.inf).all()
    assert np.isfinite(energies[:, : toy.END]).all()


def entropy_of_positions(data) -> float:
    """The least loss of a model that looks at nothing but the position in the plan."""
    many = dataclasses.replace(TRAINING, batch=1000)
    draw = quick_jit(window_batches(setup(LEVEL, training=many)))
    actions = np.asarray(draw(jax.random.key(0), data).actions)
    shares = np.stack([(actions == action).mean(axis=0) for action in range(NUM_ACTIONS)])
    return float(-(shares * np.log(np.maximum(shares, 1e-9))).sum(axis=0).mean())


@only_long
def test_it_learns_a_few_demonstrations_by_heart(local_demonstrations):
    agent = leap.make_agent(setup(LEVEL, EXACT))
    step = training.make_train_step(agent)
    data = jax.tree.map(jnp.asarray, windows.concatenate(local_demonstrations, LEVEL.extras))
    losses, accuracies = [], []

    def report(done, state, means):
        losses.append(means["loss"])
        accuracies.append(means["accuracy"])

    state = quick_jit(agent.init)(jax.random.key(0))
    training.train(step, state, data, jax.random.key(1), TRAINING.steps, report, 25)
    assert len(losses) == 10
    assert losses[-1] < 0.6 * losses[0]
    assert losses[-1] < 0.7 * entropy_of_positions(data)
    assert accuracies[-1] > accuracies[0] + 0.15


def made_up_step(losses):
    """A train step whose losses are given."""

    def step(state, data, key):
        loss = np.float32(losses[int(state.step)])
        return state._replace(step=state.step + 1), {"loss": loss, "twice": 2 * loss}

    return step


def run(losses, report_every: int, begin: int = 0) -> list[tuple[int, dict[str, float]]]:
    reports = []
    training.train(
        made_up_step(losses),
        TrainState({}, (), np.int32(begin)),
        None,
        None,
        len(losses),
        lambda step, state, means: reports.append((step, int(state.step), means)),
        report_every,
    )
    return reports


def test_reports_hold_the_means_since_the_last():
    assert run([1, 2, 3, 4, 5, 6, 7], 3) == [
        (3, 3, {"loss": 2, "twice": 4}),
        (6, 6, {"loss": 5, "twice": 10}),
        (7, 7, {"loss": 7, "twice": 14}),
    ]
    # A run that is continued reports at the same steps.
    assert run([1, 2, 3, 4, 5, 6, 7], 3, begin=4) == [
        (6, 6, {"loss": 5.5, "twice": 11}),
        (7, 7, {"loss": 7, "twice": 14}),
    ]
    assert run([1, 2], 3, begin=2) == []


def test_slow_steps_are_reported_one_by_one(monkeypatch):
    clock = itertools.count(step=3.0)  # seconds, whenever it is looked at
    monkeypatch.setattr(training.time, "perf_counter", lambda: next(clock))
    reports = []

    def report(step, state, means):
        reports.append((step, means["loss"]))

    step, state = made_up_step([1, 2, 3, 4, 5]), TrainState({}, (), np.int32(0))
    training.train(step, state, None, None, 5, report, report_every=20, report_seconds=5.0)
    assert reports == [(2, 1.5), (4, 3.5), (5, 5)]


def test_only_so_many_steps_wait_for_their_turn():
    """Of more JAX may stop for ever, where several CPU devices exchange what they compute."""
    running, most = set(), 0

    class Loss(float):
        def block_until_ready(self):
            running.discard(id(self))
            return self

    losses = [Loss(number) for number in range(100)]

    def step(state, data, key):
        nonlocal most
        loss = losses[int(state.step)]
        running.add(id(loss))
        most = max(most, len(running))
        return state._replace(step=state.step + 1), {"loss": loss}

    training.train(step, TrainState({}, (), np.int32(0)), None, None, 100, ignore, 100)
    assert most == training.AHEAD + 1
    assert 2 * most < 32  # programs: a step is two


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("step", "reported"), [(1, 0), (5, 0), (6, 1), (8, 1), (12, 2)])
def test_a_loss_that_is_not_finite_names_its_step(bad, step, reported):
    losses = [1.0] * 12
    losses[step - 1] = bad
    losses[step:] = [math.nan] * (12 - step)  # as it goes: it never recovers
    reports = []
    with pytest.raises(NonFiniteLoss, match=rf"step {step} is "):
        training.train(
            made_up_step(losses),
            TrainState({}, (), np.int32(0)),
            None,
            None,
            12,
            lambda *report: reports.append(report),
            report_every=5,
        )
    assert len(reports) == reported


def test_a_real_run_whose_parameters_break_is_stopped(data):
    agent, step = tiny()
    state = training.train(step, agent.init(jax.random.key(0)), data, jax.random.key(1), 2, ignore)
    broken = state._replace(params=jax.tree.map(lambda p: p * jnp.nan, state.params))
    with pytest.raises(NonFiniteLoss, match="step 3 is nan"):
        training.train(step, broken, data, jax.random.key(1), 5, ignore)


def parameters_of(architecture: str) -> tuple[dict, set[tuple[str, ...]]]:
    """A model's parameters, and the paths of the modules that are embeddings or norms."""
    model = dataclasses.replace(MODEL, architecture=architecture)
    made = Setup(LEVEL, 2, 3, model, TRAINING, leap.Settings())
    module = trajectory.build(model, made.sizes, made.make_encoder())
    found = set()

    def note(call, args, kwargs, context):
        if isinstance(context.module, nn.Embed | nn.LayerNorm | encoders.GroupNorm):
            found.add(context.module.path)
        return call(*args, **kwargs)

    def touch(module, context):
        return module.logits(module.encode(context), jnp.zeros(3, jnp.int32), jnp.arange(3))

    def init(key, context):
        with nn.intercept_methods(note):
            return module.init(key, context, method=touch)

    return jax.eval_shape(init, jax.random.key(0), blank_context(LEVEL, 2)), found


@pytest.mark.parametrize("architecture", trajectory.ARCHITECTURES)
def test_weight_decay_leaves_embeddings_norms_and_biases(architecture):
    params, special = parameters_of(architecture)
    assert len(special) > 4
    mask = mask_decayed_parameters(params)
    assert jax.tree.structure(mask) == jax.tree.structure(params)
    decayed = 0
    for path, is_decayed in jax.tree_util.tree_leaves_with_path(mask):
        _, *names = (entry.key for entry in path)
        in_special_module = tuple(names[:-1]) in special
        expected = not in_special_module and names[-1] != "bias"
        assert is_decayed == expected, names
        decayed += is_decayed
    assert decayed > 10


def test_weight_decay_shrinks_what_has_no_gradient():
    config = TrainingConfig(steps=100, warmup=0, learning_rate=0.5, weight_decay=0.1)
    optimizer = make_optimizer(config)
    params = {
        "dense": {"kernel": jnp.ones((2, 2)), "bias": jnp.ones(2)},
        "norm": {"scale": jnp.ones(2)},
        "words": {"embedding": jnp.ones((3, 2))},
    }
    gradients = jax.tree.map(jnp.zeros_like, params)
    state = optimizer.init(params)
    updates, _ = jax.jit(optimizer.update)(gradients, state, params)
    after = optax.apply_updates(params, updates)
    np.testing.assert_allclose(after["dense"]["kernel"], 1 - 0.5 * 0.1, rtol=1e-6)
    for name, leaf in [("dense", "bias"), ("norm", "scale"), ("words", "embedding")]:
        np.testing.assert_array_equal(after[name][leaf], 1)


def learning_rates(config: TrainingConfig) -> np.ndarray:
    """What each step really moves: Adam's update of a constant gradient is the rate itself."""
    optimizer = make_optimizer(config)
    params = {"bias": jnp.zeros(())}

    def step(state, _):
        updates, state = optimizer.update({"bias": jnp.float32(0.5)}, state, params)
        return state, -updates["bias"]

    return np.asarray(jax.lax.scan(step, optimizer.init(params), None, length=config.steps)[1])


def test_the_learning_rate_warms_up_and_decays():
    config = TrainingConfig(steps=200, warmup=10, learning_rate=1e-2, final_fraction=0.1)
    rates = learning_rates(config)
    assert rates[0] == pytest.approx(1e-3, rel=1e-3)  # not zero: the first step counts too
    assert (np.diff(rates[:11]) > 0).all()
    assert rates.max() == rates[10] == pytest.approx(1e-2, rel=1e-3)
    assert (np.diff(rates[10:]) < 0).all()
    assert rates[-1] == pytest.approx(1e-3, rel=0.01)
    # A cosine: half way down in the middle.
    assert rates[105] == pytest.approx((1e-2 + 1e-3) / 2, rel=0.01)


@pytest.mark.parametrize("steps", [1, 5, 30])
def test_a_short_run_warms_up_for_a_tenth_of_it_at_most(steps):
    rates = learning_rates(TrainingConfig(steps=steps, warmup=100, learning_rate=1e-2))
    assert rates.argmax() == steps // 10
    assert rates.max() == pytest.approx(1e-2, rel=1e-3)
    assert (rates > 0).all()


def test_gradients_are_clipped_by_their_global_norm():
    config = TrainingConfig(steps=10, warmup=0, clip=1.0)
    # Adam forgets the scale of a gradient, so look at what it remembers of the first.
    optimizer = make_optimizer(config)
    params = {"bias": jnp.zeros(2)}
    start, update = optimizer.init(params), jax.jit(optimizer.update)

    def first_moment(gradient: list[float]) -> np.ndarray:
        _, state = update({"bias": jnp.array(gradient)}, start, params)
        [adam] = [s for s in jax.tree.leaves(state, is_leaf=is_adam) if is_adam(s)]
        return np.asarray(adam.mu["bias"]) / (1 - config.betas[0])

    def is_adam(state) -> bool:
        return isinstance(state, optax.ScaleByAdamState)

    np.testing.assert_allclose(first_moment([0.3, 0.4]), [0.3, 0.4], rtol=1e-5)
    np.testing.assert_allclose(first_moment([30.0, 40.0]), [0.6, 0.8], rtol=1e-5)


@pytest.mark.parametrize(
    ("kind", "setting", "says"),
    [
        (TrainingConfig, {"steps": -1}, "steps must be at least 0"),
        (TrainingConfig, {"clip": 0.0}, "clip must be positive, got 0"),
        (TrainingConfig, {"batch": 0}, "batch must be at least 1"),
        (TrainingConfig, {"windows": "window"}, "unknown windows 'window'"),
        (leap.Settings, {"masking": "none"}, "unknown masking 'none'"),
    ],
)
def test_settings_that_cannot_work_are_refused(kind, setting, says):
    with pytest.raises(ValueError, match=says):
        kind(**setting)


def test_an_architecture_that_the_domain_has_no_encoder_for_is_refused():
    paper = dataclasses.replace(MODEL, architecture="paper")
    with pytest.raises(UserError, match="Line has no encoder for architecture 'paper': .*leapjax"):
        leap.make_agent(setup(model=paper))


# Batches that are split over devices.


def gradient_step(step, state, data, key):
    """The gradient and the metrics of one step, and its parameters."""
    before = jax.tree.map(lambda leaf: leaf.sharding, state)
    state, metrics = step(state, data, key)
    assert jax.tree.map(lambda leaf: leaf.sharding, state) == before
    # Adam's first moment after one step from zero is the gradient times 1 - beta.
    moments = optax.tree.get(state.optimizer, "mu")
    return jax.device_get((moments, metrics)), state.params


def assert_same_step(actual, expected):
    """But for rounding, two steps have the same gradient and the same metrics."""
    (gradient, metrics), (expected_gradient, expected_metrics) = actual, expected
    assert any(np.abs(leaf).max() > 1e-3 for leaf in jax.tree.leaves(expected_gradient))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6),
        gradient, expected_gradient,
    )  # fmt: skip
    assert metrics.keys() == expected_metrics.keys() >= {"loss", "accuracy", "gradient_norm"}
    for name, value in expected_metrics.items():
        assert metrics[name] == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize("fsdp", [2, pytest.param(1, marks=only_long)])
def test_a_step_split_over_devices_is_the_step_of_one(fsdp, data):
    agent, step = tiny()
    key = jax.random.key(0)
    drawn = step.draw(key, jnp.int32(0), data)
    expected, _ = gradient_step(step, agent.init(key), data, key)

    mesh = sharding.make_mesh(TRAINING.batch, fsdp=fsdp)
    assert mesh.size == 8
    agent = leap.make_agent(setup(), mesh)
    data = sharding.replicate(data, mesh)
    begin, step = training.compile_ahead(agent, mesh, make_blank_steps(toy.DOMAIN))
    begun = begin(0)
    rows = step.draw(begun[1], begun[0].step, data)
    jax.tree.map(np.testing.assert_array_equal, rows, drawn)
    assert {leaf.addressable_data(0).shape[0] for leaf in jax.tree.leaves(rows)} == {2}
    actual, params = gradient_step(step, begun[0], data, begun[1])
    largest = max(jax.tree.leaves(params), key=lambda leaf: leaf.size)
    assert largest.size >= sharding.SMALLEST_SPLIT
    assert largest.sharding.shard_shape(largest.shape) != largest.shape or fsdp == 1
    assert largest.addressable_data(0).size == largest.size // fsdp
    assert_same_step(actual, expected)


@pytest.mark.parametrize(
    "microbatch", [6, *(pytest.param(size, marks=only_long) for size in (20, 8, 1))]
)
def test_a_step_in_parts_is_the_step_of_the_whole_batch(microbatch, data):
    agent, step = tiny()
    key = jax.random.key(0)
    expected, _ = gradient_step(step, agent.init(key), data, key)
    in_parts = dataclasses.replace(TRAINING, microbatch=microbatch)
    step = training.make_train_step(leap.make_agent(setup(training=in_parts)))
    actual, _ = gradient_step(step, agent.init(key), data, key)
    assert_same_step(actual, expected)


@only_long
@pytest.mark.parametrize("repeat_state", [True, False])
def test_a_step_of_the_papers_network_in_parts_is_that_of_all(repeat_state, local_demonstrations):
    data = jax.tree.map(jnp.asarray, windows.concatenate(local_demonstrations, LEVEL.extras))
    settings = leap.Settings(masking="each", repeat_state=repeat_state)
    model, key = dataclasses.replace(MODEL, architecture="paper"), jax.random.key(0)

    def gradient(microbatch, mesh=None):
        parts = dataclasses.replace(TRAINING, batch=8, microbatch=microbatch)
        agent = leap.make_agent(Setup(LEVEL, 0, 3, model, parts, settings), mesh)
        state, batch = quick_jit(agent.init)(key), quick_jit(agent.batch)(key, data)
        if mesh is not None:
            state = sharding.place(state, sharding.parameter_shardings(state, mesh))
        state, metrics = quick_jit(agent.update)(state, batch, key)
        return jax.device_get((optax.tree.get(state.optimizer, "mu"), metrics))

    whole = gradient(0)
    assert_same_step(gradient(3), whole)
    assert_same_step(gradient(2, sharding.make_mesh(8, jax.devices()[:2])), whole)
    last = whole[0]["params"]["state"]["FiLMBlock_3"]
    assert all(np.abs(leaf).max() > 1e-7 for leaf in jax.tree.leaves(last))


def test_a_mesh_has_as_many_devices_as_split_the_batch():
    assert len(jax.devices()) == 8
    sizes = {batch: sharding.make_mesh(batch).size for batch in (1, 2, 7, 12, 22, 64)}
    assert sizes == {1: 1, 2: 2, 7: 7, 12: 6, 22: 2, 64: 8}
    with pytest.raises(ValueError, match="at least one device"):
        sharding.make_mesh(4, [])


@pytest.mark.parametrize(("batch", "fsdp"), [(7, 8), (12, 5), (8, 3)])
def test_a_mesh_that_cannot_be_is_refused(batch, fsdp):
    with pytest.raises(ValueError, match=f"a batch of {batch} and parameters split in {fsdp}"):
        sharding.make_mesh(batch, fsdp=fsdp)


def test_large_parameters_are_split_and_small_ones_are_not():
    mesh = sharding.make_mesh(8, fsdp=4)
    tree = {
        "tall": jnp.zeros((512, 12)), "wide": jnp.zeros((6, 1024)), "odd": jnp.zeros((333, 77)),
        "small": jnp.zeros((4, 4)), "step": jnp.int32(0),
    }  # fmt: skip
    specs = sharding.parameter_specs(tree, mesh)
    assert specs["tall"] == jax.P("fsdp") and specs["wide"] == jax.P(None, "fsdp")
    assert specs["odd"] == specs["small"] == specs["step"] == jax.P()
    placed = sharding.place(tree, sharding.parameter_shardings(tree, mesh))
    assert placed["wide"].addressable_data(0).shape == (6, 256)
    assert_identical(sharding.to_host(placed), jax.device_get(tree))


def test_a_checkpoint_goes_on_with_another_split_of_the_parameters(tmp_path):
    states = {}
    for fsdp in (1, 4):
        mesh = sharding.make_mesh(8, fsdp=fsdp)
        agent = leap.make_agent(setup(), mesh)
        states[fsdp], _ = training.make_begin(agent, mesh)(fsdp)
    saved = Checkpoints(tmp_path / "checkpoints")
    saved.save(states[4])
    saved.close()
    restored = Checkpoints(tmp_path / "checkpoints").restore(states[1])
    assert_identical(restored, sharding.to_host(states[4]))
    kept = jax.tree.map(lambda leaf: leaf.sharding, restored)
    assert kept == jax.tree.map(lambda leaf: leaf.sharding, states[1])


# What no gradient touches.


RATE, MOMENTUM, KEPT, SIZE = 0.1, 0.5, 0.9, 32  # SIZE^2 is just enough to be split


def average_agent(mesh) -> Agent:
    """Least squares against half of its own slow average."""
    optimizer = optax.sgd(RATE, MOMENTUM)

    def loss(params, extra, batch, keys):
        inputs, targets = batch
        wanted = targets + 0.5 * inputs @ extra["average"]
        return 0.5 * jnp.sum((inputs @ params["w"] - wanted) ** 2, axis=1).mean(), {}

    def next_extra(extra, params):
        average = KEPT * extra["average"] + (1 - KEPT) * params["w"]
        return {"average": average, "steps": extra["steps"] + 1}

    def init(key):
        w = jax.random.normal(key, (SIZE, SIZE))
        extra = {"average": jnp.ones((SIZE, SIZE)), "steps": jnp.int32(0)}
        return TrainState({"w": w}, optimizer.init({"w": w}), jnp.int32(0), extra)

    update = make_update(loss, optimizer, mesh, next_extra)
    return Agent(init, lambda key, data: data, update, None)


def averages(w, inputs, targets, steps):
    """The same in NumPy."""
    average, velocity = np.ones_like(w), np.zeros_like(w)
    for _ in range(steps):
        errors = inputs @ w - targets - 0.5 * inputs @ average
        velocity = MOMENTUM * velocity + inputs.T @ errors / len(inputs)
        w = w - RATE * velocity
        average = KEPT * average + (1 - KEPT) * w
    return w, average


@pytest.mark.parametrize("fsdp", [None, 1, 8])
def test_extra_state_follows_the_parameters_and_not_the_gradient(fsdp, tmp_path):
    rng = np.random.default_rng(0)
    data = tuple(rng.normal(size=(16, SIZE)).astype(np.float32) for _ in range(2))
    mesh = sharding.make_mesh(16, fsdp=fsdp) if fsdp else None
    agent = average_agent(mesh)
    if mesh is None:
        begin = lambda seed: (agent.init(jax.random.key(seed)), jax.random.key(seed))  # noqa: E731
    else:
        begin, data = training.make_begin(agent, mesh), sharding.replicate(data, mesh)
    step = training.make_train_step(agent, mesh)

    state, key = begin(0)
    w = np.asarray(state.params["w"], np.float64)
    split = state.extra["average"].addressable_data(0).size
    assert split == SIZE**2 // (fsdp or 1)
    state = training.train(step, state, data, key, 3, ignore)
    saved = Checkpoints(tmp_path / "checkpoints")
    saved.save(state)
    restored = saved.restore(begin(1)[0])
    saved.close()
    assert_identical(restored, state)
    state = training.train(step, restored, data, key, 5, ignore)

    expected = averages(w, *(np.asarray(part, np.float64) for part in data), 5)
    np.testing.assert_allclose(state.params["w"], expected[0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(state.extra["average"], expected[1], rtol=1e-4, atol=1e-5)
    assert state.extra["steps"] == 5
    assert state.extra["average"].addressable_data(0).size == split
