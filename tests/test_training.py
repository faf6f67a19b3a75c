import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from leapjax import schedules, sharding, training
from leapjax.agents import leap
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.agents.batches import make_blank_steps, window_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.update import make_update
from leapjax.checkpoints import Checkpoints
from leapjax.data import windows
from leapjax.domain import Augmentations, blank_context
from leapjax.models.config import ModelConfig
from leapjax.training import NonFiniteLoss
from leapjax.types import Agent, TrainState
from tests import toy
from tests.parameters import random_parameters
from tests.programs import only_long
from tests.quick import quick_jit

MODEL = ModelConfig(layers=1, heads=2, width=16)
EXACT = dataclasses.replace(MODEL, dropout=0.0)
TRAINING = TrainingConfig(steps=250, batch=16, warmup=20, learning_rate=1e-2)


def make_setup(domain=toy.DOMAIN, model=MODEL, training=TRAINING) -> Setup:
    return Setup(domain, 0, 4, model, training, leap.Settings())


@functools.cache
def make_tiny() -> tuple[Agent, training.TrainStep]:
    """An agent and its train step, compiled once for all tests."""
    agent = leap.make_agent(make_setup())
    return agent._replace(init=quick_jit(agent.init)), training.make_train_step(agent)


@pytest.fixture(scope="module")
def data():
    return jax.tree.map(jnp.asarray, windows.concatenate(toy.demonstrations()))


def ignore(step, state, means):
    pass


def assert_identical(a, b) -> None:
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


def save_and_restore(folder, state, like):
    """Saves a state, and restores it as another process would."""
    saved = Checkpoints(folder / "checkpoints")
    saved.save(state)
    saved.close()
    return Checkpoints(folder / "checkpoints").restore(like)


def test_a_resumed_run_equals_an_uninterrupted_run(data, tmp_path):
    agent, step = make_tiny()
    key = jax.random.key(7)
    whole = training.train(step, agent.init(jax.random.key(0)), lambda done: data, key, 6, ignore)
    first = training.train(step, agent.init(jax.random.key(0)), lambda done: data, key, 3, ignore)
    restored = save_and_restore(tmp_path, first, agent.init(jax.random.key(1)))
    assert_identical(restored, first)
    assert_identical(training.train(step, restored, lambda done: data, key, 6, ignore), whole)
    assert int(whole.step) == 6


def test_batch_k_and_its_noise_depend_only_on_the_key_and_k(data):
    def update(state, batch, key):
        """Reports its batch and its key, and leaves the parameters as they are."""
        metrics = {"batch": batch, "key": jax.random.key_data(key)}
        return state._replace(step=state.step + 1), metrics

    step = training.make_train_step(Agent(None, window_batches(make_setup()), update, None))

    def at(k, weight=0.0, seed=3):
        return step(
            TrainState({"w": jnp.full(3, weight)}, (), jnp.int32(k)), data, jax.random.key(seed)
        )[1]

    records = [at(k) for k in range(4)]
    for k in (3, 0, 2, 1):  # in any order, for any parameters
        assert_identical(at(k, weight=float(k)), records[k])
    all_records = [*records, at(0, seed=4), at(1000)]
    for name in ("batch", "key"):
        prints = {
            b"".join(map(bytes, jax.tree.leaves(jax.device_get(e[name])))) for e in all_records
        }
        assert len(prints) == 6  # all batches and all keys differ
    batch_key = jax.random.fold_in(jax.random.key(3), training.BATCH_STREAM)
    drawn_with = jax.random.key_data(jax.random.fold_in(batch_key, 0))
    assert not np.array_equal(records[0]["key"], drawn_with)  # noise is independent of the batch


def test_augmentations_apply_last_to_first_with_separate_keys(data):
    def double(key, window):
        extras = (*window.extras, jax.random.uniform(key))
        return window._replace(extras=extras, actions=2 * window.actions)

    def shift(key, window):
        extras = (*window.extras, jax.random.uniform(key))
        return window._replace(extras=extras, actions=window.actions + 1)

    def draw(*augmentations):
        domain = toy.DOMAIN._replace(augmentations=Augmentations(augmentations))
        return jax.jit(window_batches(make_setup(domain)))(jax.random.key(0), data)

    first, second = draw(double, shift), draw(shift, double)
    np.testing.assert_array_equal(first.actions, 2 * ((second.actions - 1) // 2 + 1))
    assert len(np.unique(np.stack(first.extras))) == 2 * TRAINING.batch


@pytest.mark.parametrize(
    ("masking", "end"),
    [("each", False), ("random", True), pytest.param("all", True, marks=only_long)],
)
def test_the_loss_is_the_mean_cross_entropy_of_masked_actions(masking, end, data, monkeypatch):
    """Equation 1, one position at a time. Without an end action, PAD is only an input."""
    setup = make_setup(model=EXACT)._replace(settings=leap.Settings(masking=masking, end=end))
    agent, horizon = leap.make_agent(setup), setup.horizon
    compiled, step = make_tiny()
    params = (state := compiled.init(jax.random.key(0))).params
    masks, sample = [], schedules.sample_masks

    def record_masks(key, *rest):
        found = sample(key, *rest)
        jax.debug.callback(lambda mask: masks.append(np.asarray(mask)), found)
        return found

    monkeypatch.setattr(schedules, "sample_masks", record_masks)
    update, energy, pad = quick_jit(agent.update), agent.energy, toy.DOMAIN.num_actions + 1

    @jax.jit
    def negative_log_likelihoods(context, actions, masked):
        memory = energy.encode(params, context)

        def at(position):  # the other masked positions stay masked
            tokens = jnp.where(masked, pad - 1, actions)
            energies = energy.conditional(params, memory, tokens, position[None])[0]
            return energies[actions[position]] + jax.nn.logsumexp(-energies)

        return jax.lax.map(at, jnp.arange(horizon))

    batch = step.draw(jax.random.key(1), 0, data)
    ended = 0
    for row in range(3):
        one = jax.tree.map(lambda leaf, r=row: leaf[r : r + 1], batch)
        imitated = np.arange(horizon) >= row  # earlier actions are inputs, not targets
        one = one._replace(imitated=jnp.asarray(imitated)[None])
        _, metrics = update(state, one, jax.random.key(row))
        jax.effects_barrier()
        beyond = np.asarray(one.actions[0] == toy.END) & (not end)
        ended += beyond.sum()
        context = jax.tree.map(lambda leaf: leaf[0], one.context)
        total = 0.0
        for masked in masks[-1].reshape(-1, horizon) & imitated:
            each = negative_log_likelihoods(context, jnp.where(beyond, pad, one.actions[0]), masked)
            total += float(jnp.where(masked & ~beyond, each, 0).sum())
        assert float(metrics["loss"]) == pytest.approx(total / masks[-1].sum(), rel=1e-4)
    assert ended > 0 or end


def test_without_an_end_action_no_plan_ends():
    setup = make_setup()._replace(settings=leap.Settings(masking="each", end=False))
    agent = leap.make_agent(setup)
    energy, params = agent.energy, random_parameters(agent)
    memory = quick_jit(energy.encode)(params, blank_context(toy.DOMAIN, 0))
    conditional = quick_jit(energy.conditional)
    energies = conditional(params, memory, np.full(4, toy.END + 1), np.arange(4))
    assert np.isinf(energies).tolist() == [[False, False, False, True]] * 4


def run_training(losses, report_every=20, begin=0, loss=np.float32, **options):
    """Trains with given losses; returns the reported steps and mean losses."""

    def step(state, data, key):
        metrics = {"loss": loss(losses[int(state.step)])}
        return state._replace(step=state.step + 1), metrics

    reports = []

    def add_report(done, state, means):
        assert done == state.step and math.isfinite(means["loss"])
        reports.append((done, means["loss"]))

    state = TrainState({}, (), np.int32(begin))
    training.train(
        step, state, lambda done: None, None, len(losses), add_report, report_every, **options
    )
    return reports


def test_reports_hold_the_means_since_the_last_report():
    losses = [1, 2, 3, 4, 5, 6, 7]
    assert run_training(losses, 3) == [(3, 2), (6, 5), (7, 7)]
    assert run_training(losses, 3, begin=4) == [(6, 5.5), (7, 7)]  # resumed: at the same steps
    assert run_training([1, 2], 3, begin=2) == []


def test_slow_steps_are_reported_more_often(monkeypatch):
    clock = itertools.count(step=3.0)  # seconds from one reading to the next
    monkeypatch.setattr(training.time, "perf_counter", lambda: next(clock))
    assert run_training([1, 2, 3, 4, 5], report_seconds=5.0) == [(2, 1.5), (4, 3.5), (5, 5)]


def test_the_number_of_queued_steps_is_bounded():
    """JAX may deadlock on several CPU devices if more than 32 programs are queued."""
    running, queued = set(), []

    class Loss(float):
        def __init__(self, number):
            running.add(number)
            queued.append(len(running))

        def block_until_ready(self):
            running.discard(float(self))
            return self

    run_training(range(100), 100, loss=Loss)
    assert max(queued) == training.AHEAD + 1
    assert 2 * max(queued) < 32  # a step is two programs


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("step", [1, 5, 6, 12])
def test_a_non_finite_loss_raises_an_error_that_names_its_step(bad, step):
    with pytest.raises(NonFiniteLoss, match=rf"the loss of step {step} is {bad}"):
        run_training([*[1.0] * (step - 1), bad, *[math.nan] * (12 - step)], 5)


def test_weight_decay_skips_embeddings_norms_and_biases():
    config = TrainingConfig(steps=100, warmup=0, learning_rate=0.5, weight_decay=0.1)
    optimizer = make_optimizer(config)
    params = {
        "dense": {"kernel": jnp.ones((2, 2)), "bias": jnp.ones(2)},
        "norm": {"scale": jnp.ones(2)},
        "words": {"embedding": jnp.ones((3, 2))},
    }
    zeros = jax.tree.map(jnp.zeros_like, params)
    updates, _ = jax.jit(optimizer.update)(zeros, optimizer.init(params), params)
    np.testing.assert_allclose(updates["dense"].pop("kernel"), -0.5 * 0.1, rtol=1e-6)
    assert not any(leaf.any() for leaf in jax.tree.leaves(updates))


def measure_learning_rates(config: TrainingConfig) -> np.ndarray:
    """Measures the rate of each step: Adam's update of a constant gradient is the rate."""
    optimizer = make_optimizer(config)
    params = {"bias": jnp.zeros(())}

    def step(state, _):
        updates, state = optimizer.update({"bias": jnp.float32(0.5)}, state, params)
        return state, -updates["bias"]

    return np.asarray(jax.lax.scan(step, optimizer.init(params), None, length=config.steps)[1])


def test_the_learning_rate_warms_up_and_decays():
    config = TrainingConfig(steps=200, warmup=10, learning_rate=1e-2, final_fraction=0.1)
    rates = measure_learning_rates(config)
    assert rates[0] == pytest.approx(1e-3, rel=1e-3)  # not zero: the first step counts too
    assert (np.diff(rates[:11]) > 0).all() and (np.diff(rates[10:]) < 0).all()
    # A cosine: half way down in the middle.
    np.testing.assert_allclose(rates[[10, 105, -1]], [1e-2, 5.5e-3, 1e-3], rtol=0.01)


@pytest.mark.parametrize("steps", [1, 5, 30])
def test_the_warmup_takes_at_most_a_tenth_of_a_run(steps):
    rates = measure_learning_rates(TrainingConfig(steps=steps, warmup=100, learning_rate=1e-2))
    assert rates.argmax() == steps // 10
    assert rates.max() == pytest.approx(1e-2, rel=1e-3)
    assert (rates > 0).all()


def test_gradients_are_clipped_by_their_global_norm():
    # Adam's update does not depend on the scale of a gradient, but its first moment does.
    config = TrainingConfig(steps=10, warmup=0, clip=1.0)
    optimizer, params = make_optimizer(config), {"bias": jnp.zeros(2)}
    for gradient, clipped in ([0.3, 0.4], [0.3, 0.4]), ([30.0, 40.0], [0.6, 0.8]):
        _, state = optimizer.update({"bias": jnp.array(gradient)}, optimizer.init(params), params)
        moment = optax.tree.get(state, "mu")["bias"] / (1 - config.betas[0])
        np.testing.assert_allclose(moment, clipped, rtol=1e-5)


# Batches split over devices.


def get_moments_and_metrics(state, metrics):
    """Returns Adam's first moment (after one step, the gradient times 1 - beta) and metrics."""
    return jax.device_get(optax.tree.get(state.optimizer, "mu")), jax.tree.map(float, metrics)


def assert_same_step(actual, expected):
    """Asserts that two steps have equal gradients and equal metrics, up to rounding."""
    (gradient, metrics), (expected_gradient, expected_metrics) = actual, expected
    assert any(np.abs(leaf).max() > 1e-3 for leaf in jax.tree.leaves(expected_gradient))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-6)
    jax.tree.map(close, gradient, expected_gradient)
    assert metrics.keys() >= {"loss", "accuracy", "gradient_norm"}
    assert metrics == pytest.approx(expected_metrics, rel=1e-4)


@pytest.mark.parametrize("fsdp", [2, pytest.param(1, marks=only_long)])
def test_a_step_on_several_devices_equals_a_step_on_one(fsdp, data):
    agent, step = make_tiny()
    key = jax.random.key(0)
    drawn = step.draw(key, jnp.int32(0), data)
    expected = get_moments_and_metrics(*step(agent.init(key), data, key))

    mesh = sharding.make_mesh(TRAINING.batch, fsdp=fsdp)
    assert mesh.size == 8
    data = sharding.replicate(data, mesh)
    agent = leap.make_agent(make_setup(), mesh)
    begin, step = training.compile_ahead(agent, mesh, make_blank_steps(toy.DOMAIN))
    state, key = begin(0)
    rows = step.draw(key, state.step, data)
    assert_identical(rows, drawn)
    assert {leaf.addressable_data(0).shape[0] for leaf in jax.tree.leaves(rows)} == {2}
    places = jax.tree.map(lambda leaf: leaf.sharding, state)
    state, metrics = step(state, data, key)
    assert jax.tree.map(lambda leaf: leaf.sharding, state) == places
    largest = max(jax.tree.leaves(state.params), key=lambda leaf: leaf.size)
    assert largest.addressable_data(0).size == largest.size // fsdp
    assert_same_step(get_moments_and_metrics(state, metrics), expected)


@pytest.mark.parametrize("microbatch", [6, *(pytest.param(n, marks=only_long) for n in (20, 1))])
def test_a_step_in_microbatches_equals_a_step_on_the_whole_batch(microbatch, data):
    agent, step = make_tiny()
    key = jax.random.key(0)
    expected = get_moments_and_metrics(*step(agent.init(key), data, key))
    in_parts = dataclasses.replace(TRAINING, microbatch=microbatch)
    step = training.make_train_step(leap.make_agent(make_setup(training=in_parts)))
    assert_same_step(get_moments_and_metrics(*step(agent.init(key), data, key)), expected)


def test_a_mesh_has_the_most_devices_that_divide_the_batch():
    sizes = {batch: sharding.make_mesh(batch).size for batch in (1, 2, 7, 12, 22, 64)}
    assert sizes == {1: 1, 2: 2, 7: 7, 12: 6, 22: 2, 64: 8}
    for batch, fsdp in ((7, 8), (12, 5), (8, 3)):
        with pytest.raises(ValueError, match=f"batch of {batch} and parameters split in {fsdp}"):
            sharding.make_mesh(batch, fsdp=fsdp)


def test_only_large_divisible_parameters_are_split():
    mesh = sharding.make_mesh(8, fsdp=4)
    shapes = {"tall": (512, 12), "wide": (6, 1024), "odd": (333, 77), "small": (4, 4), "step": ()}
    tree = {name: jnp.zeros(shape) for name, shape in shapes.items()}
    specs = sharding.parameter_specs(tree, mesh)
    assert specs["tall"] == jax.P("fsdp") and specs["wide"] == jax.P(None, "fsdp")
    assert specs["odd"] == specs["small"] == specs["step"] == jax.P()


def test_a_checkpoint_restores_with_another_split_of_the_parameters(tmp_path):
    states = {}
    for fsdp in (1, 4):
        mesh = sharding.make_mesh(8, fsdp=fsdp)
        states[fsdp], _ = training.make_begin(leap.make_agent(make_setup(), mesh), mesh)(fsdp)
    restored = save_and_restore(tmp_path, states[4], states[1])
    assert_identical(restored, sharding.to_host(states[4]))
    for leaf, like in zip(*map(jax.tree.leaves, (restored, states[1])), strict=True):
        assert leaf.sharding == like.sharding


# Extra state.


RATE, MOMENTUM, KEPT, SIZE = 0.1, 0.5, 0.9, 32  # SIZE^2 is just enough to be split


def make_average_agent(mesh) -> Agent:
    """Makes a least-squares agent whose targets include half of its average's prediction."""
    optimizer = optax.sgd(RATE, MOMENTUM)

    def loss(params, extra, batch, keys):
        inputs, targets = batch
        target = targets + 0.5 * inputs @ extra["average"]
        return 0.5 * jnp.sum((inputs @ params["w"] - target) ** 2, axis=1).mean(), {}

    def next_extra(extra, params):
        return {"average": KEPT * extra["average"] + (1 - KEPT) * params["w"]}

    def init(key):
        params = {"w": jax.random.normal(key, (SIZE, SIZE))}
        extra = {"average": jnp.ones((SIZE, SIZE))}
        return TrainState(params, optimizer.init(params), jnp.int32(0), extra)

    update = make_update(loss, optimizer, mesh, next_extra)
    return Agent(init, lambda key, data: data, update, None)


def compute_averages(w, inputs, targets, steps):
    """Computes the parameters and their average after some steps, in NumPy."""
    average, velocity = np.ones_like(w), np.zeros_like(w)
    for _ in range(steps):
        errors = inputs @ w - targets - 0.5 * inputs @ average
        velocity = MOMENTUM * velocity + inputs.T @ errors / len(inputs)
        w = w - RATE * velocity
        average = KEPT * average + (1 - KEPT) * w
    return w, average


@pytest.mark.parametrize("fsdp", [1, 8])
def test_extra_state_follows_parameters_without_gradients(fsdp):
    rng = np.random.default_rng(0)
    data = tuple(rng.normal(size=(16, SIZE)).astype(np.float32) for _ in range(2))
    mesh = sharding.make_mesh(16, fsdp=fsdp)
    agent = make_average_agent(mesh)
    state, key = training.make_begin(agent, mesh)(0)
    w = np.asarray(state.params["w"], np.float64)
    step, placed = training.make_train_step(agent, mesh), sharding.replicate(data, mesh)
    state = training.train(step, state, lambda done: placed, key, 5, ignore)
    expected = compute_averages(w, *(np.asarray(part, np.float64) for part in data), 5)
    for actual, target in zip((state.params["w"], state.extra["average"]), expected, strict=True):
        np.testing.assert_allclose(actual, target, rtol=1e-4, atol=1e-5)
        assert actual.addressable_data(0).size == SIZE**2 // fsdp
