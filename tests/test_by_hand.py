"""The losses of methods, written down once more.

Each is a function of the trained parameters alone: all that a method holds fixed is computed
before, so that not only its value but also its gradient says whether the method is what it is.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from leapjax.agents import bc, bcq, classifier, cql, iql, mopo, plate, qr_dqn, rem
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.data import windows
from leapjax.models.config import ModelConfig
from tests import mixed, toy
from tests.parameters import random_like
from tests.programs import only_long
from tests.quick import quick_jit

BATCH, PAST, WIDTH, CHOICES, DISCOUNT = 16, 2, 16, 2, 0.9
DOMAIN = mixed.DOMAIN._replace(actions=("left", "right", "end"))
MODEL = ModelConfig("paper", layers=1, heads=1, width=WIDTH, dropout=0.0)
KEY = jax.random.key(4)
KEYS = jax.vmap(jax.random.fold_in, (None, 0))(KEY, np.arange(BATCH))  # of examples
DRAWS = jax.vmap(jax.random.split)(KEYS)[:, 1]  # where they drop nothing out with the others
IQL = {
    "discount": DISCOUNT, "expectile": 0.8, "inverse_temperature": 2.0, "largest_weight": 1.5
}  # fmt: skip


class Case(NamedTuple):
    """An agent, parameters and others for the target network, and transitions."""

    setup: Setup
    agent: object
    state: object
    batch: object


def make_case(module, settings, domain=DOMAIN, horizon=1):
    """On mixed steps, or on plans of demonstrations."""
    learn = TrainingConfig(batch=BATCH, windows="step")
    setup = Setup(domain, PAST, horizon, MODEL, learn, settings)
    agent = module.make_agent(setup)
    state = random_like(jax.eval_shape(agent.init, jax.random.key(0)))
    data = mixed.steps() if horizon == 1 else windows.concatenate(toy.demonstrations())
    batch = quick_jit(agent.batch)(jax.random.key(3), jax.tree.map(jnp.asarray, data))
    return Case(setup, agent, state, batch)


def assert_is(case, loss):
    """The agent's loss, and the norm of its gradient, are those of a function of parameters.

    A target network that has all of its parameters follows slowly.
    """
    after, found = quick_jit(case.agent.update)(case.state, case.batch, KEY)
    if jax.tree.structure(after.extra) == jax.tree.structure(after.params):
        rate = case.setup.settings.target_rate
        expected = optax.incremental_update(after.params, case.state.extra, rate)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
            after.extra, expected,
        )  # fmt: skip
    expected, gradient = quick_jit(jax.value_and_grad(loss))(case.state.params)
    assert float(found["loss"]) == pytest.approx(float(expected), rel=1e-4)
    norm = float(optax.tree.norm(gradient))
    assert float(found["gradient_norm"]) == pytest.approx(norm, rel=1e-3)


class Around(NamedTuple):
    """Steps [B, P] and the contexts before and after the last of them."""

    earlier: object
    after: object
    taken: jax.Array
    rewards: jax.Array
    goes_on: jax.Array
    known: jax.Array  # where the episode had begun

    def returned(self, value):
        """Each reward, and the discounted value [B, P] of the state that it led to."""
        return self.rewards + DISCOUNT * self.goes_on * value


def around(batch):
    earlier, after = (jax.vmap(f)(batch.context) for f in (windows.before, windows.after))
    known = batch.context.actions < CHOICES
    assert batch.terminated.any() and not known.all() and known[:, -1].all()
    return Around(
        earlier, after, jnp.where(known, batch.context.actions, 0), batch.context.rewards,
        jnp.ones(known.shape).at[:, -1].set(1.0 - batch.terminated), known,
    )  # fmt: skip


def mean(values, known):
    """Over the steps [P] of each example, then over examples."""
    return (jnp.where(known, values, 0).sum(axis=1) / known.sum(axis=1)).mean()


def at(values, index):
    return jnp.take_along_axis(values, index[..., None], axis=-1)[..., 0]


def huber(errors):
    size = jnp.abs(errors)
    return jnp.where(size <= 1, size**2 / 2, size - 1 / 2)


def cross_entropy(logits, taken):
    return jax.nn.logsumexp(logits, axis=-1) - at(logits, taken)


def caller(module):
    """(parameters, method, *inputs) -> what a network says of each of a batch."""

    def call(params, method, *inputs):
        apply = functools.partial(module.apply, method=method)
        return jax.vmap(apply, (None, *(0 for _ in inputs)))(params, *inputs)

    return call


def many(module):
    """(parameters, contexts) -> the same, of a network that has but one thing to say."""
    call = caller(module)
    return lambda params, contexts: call(params, "__call__", contexts)


def test_bc():
    """Of every state of a context; not of what was before the episode."""
    case = make_case(bc, bc.Settings())
    encode = jax.vmap(case.agent.energy.encode, (None, 0))
    actions = jnp.concatenate([case.batch.context.actions, case.batch.actions], axis=1)
    known = actions < CHOICES
    assert not known.all()

    def loss(params):
        logits = encode(params, case.batch.context)["logits"]
        return mean(cross_entropy(logits, jnp.where(known, actions, 0)), known)

    assert_is(case, loss)


def test_classifier():
    case = make_case(classifier, classifier.Settings(), mixed.DOMAIN, horizon=4)
    setup, batch = case.setup, case.batch
    call = caller(classifier.SequenceClassifier(setup.model, setup.sizes, setup.make_encoder()))
    corrupted, degrees = jax.vmap(classifier.corrupt, (0, 0, 0, None))(
        KEYS, batch.actions, batch.imitated, toy.DOMAIN.num_actions
    )

    def loss(params):
        found = call(params, "degree", call(params, "encode", batch.context), corrupted)
        return ((found - degrees) ** 2).mean()

    assert_is(case, loss)
    assert not case.agent.energy.accepts_mask


def test_bcq():
    case = make_case(bcq, bcq.Settings(discount=DISCOUNT, threshold=0.9))
    steps = around(case.batch)
    say = many(case.setup.make_policy(("q", CHOICES), ("behaviour", CHOICES)))
    later, held = (say(of, steps.after) for of in (case.state.params, case.state.extra))
    likely = jax.nn.softmax(later["behaviour"])
    likely = likely / likely.max(axis=-1, keepdims=True) >= 0.9
    best = jnp.where(likely, later["q"], -jnp.inf).argmax(axis=-1)
    assert (best != later["q"].argmax(axis=-1)).any()
    target = steps.returned(at(held["q"], best))

    def loss(params):
        now = say(params, steps.earlier)
        difference = huber(target - at(now["q"], steps.taken))
        imitation = cross_entropy(now["behaviour"], steps.taken)
        squares = (now["behaviour"] ** 2).mean(axis=-1)
        return mean(difference + 0.01 * squares + imitation, steps.known)

    assert_is(case, loss)


def iql_loss(value, qs, least, logits, returns, taken):
    """`least` and `returns` are held fixed."""
    advantage = least - value
    weight = jnp.minimum(jnp.exp(2.0 * jax.lax.stop_gradient(advantage)), 1.5)
    return (
        jnp.where(advantage > 0, 0.8, 0.2) * advantage**2
        + sum((returns - at(q, taken)) ** 2 for q in qs)
        + weight * cross_entropy(logits, taken)
    )


def test_iql():
    case = make_case(iql, iql.Settings(**IQL))
    steps, params = around(case.batch), case.state.params["params"]
    critic = many(case.setup.make_policy(("value", 1), ("q1", CHOICES), ("q2", CHOICES)))
    policy = many(case.setup.make_policy(("logits", CHOICES)))
    later = critic({"params": params["critic"]}, steps.after)["value"][..., 0]
    returns = steps.returned(later)
    held = critic(case.state.extra, steps.earlier)
    least = jnp.minimum(at(held["q1"], steps.taken), at(held["q2"], steps.taken))

    def loss(params):
        now = critic({"params": params["params"]["critic"]}, steps.earlier)
        logits = policy({"params": params["params"]["policy"]}, steps.earlier)["logits"]
        value, qs = now["value"][..., 0], (now["q1"], now["q2"])
        return mean(iql_loss(value, qs, least, logits, returns, steps.taken), steps.known)

    assert_is(case, loss)


@only_long
def test_mopo():
    """Of the data, and of what is imagined, two steps far."""
    settings = mopo.Settings(**IQL, members=3, rollout=2, penalty=0.7, real_share=0.5)
    case = make_case(mopo, settings)
    steps, old, target = around(case.batch), case.state.params, case.state.extra
    call = caller(mopo.Networks(case.setup.make_policy(("features", WIDTH)), CHOICES, 3))

    seen, seen_later = (call(target, "features", of) for of in (steps.earlier, steps.after))
    later = call(old, "judge", call(old, "features", steps.after))[0]
    returns = steps.returned(later)

    def least_of(features, taken):
        _, *qs = call(target, "judge", features)
        return jnp.minimum(*(at(q, taken) for q in qs))

    def of_data(params):
        now = call(params, "features", steps.earlier)
        value, *qs = call(params, "judge", now)
        logits = call(params, "logits", jax.lax.stop_gradient(now))
        policy = iql_loss(value, qs, least_of(seen, steps.taken), logits, returns, steps.taken)
        said = call(params, "predict", seen, steps.taken)  # [B, M, P, ...]
        ends = jnp.zeros(steps.known.shape).at[:, -1].set(case.batch.terminated)[:, None]
        ended = jnp.where(ends > 0, said.ending, -said.ending)
        ensemble = (
            ((said.features - seen_later[:, None]) ** 2).mean(axis=-1)
            + (said.reward - steps.rewards[:, None]) ** 2
            + jnp.logaddexp(0, -ended)
        ).sum(axis=1)
        cloned = cross_entropy(call(params, "behaviour", now), steps.taken)
        return mean(0.5 * policy + ensemble + cloned, steps.known)

    imagined = []  # features [B, 1, D], actions, returns, and how alive it still is
    features, alive = seen[:, -1:], jnp.ones((BATCH, 1))
    for step in range(2):
        draws = jax.vmap(lambda key, step=step: jax.random.split(jax.random.split(key, 2)[step]))(
            DRAWS
        )
        logits = call(old, "logits", features)
        taken = jax.vmap(jax.random.categorical)(draws[:, 0], logits)
        said = call(old, "predict", features, taken)
        spread = jnp.sqrt(said.features.var(axis=1).mean(axis=-1)) + said.reward.std(axis=1)
        goes_on = 1 - (1 / (1 + jnp.exp(-said.ending))).mean(axis=1)
        member = jax.vmap(lambda key: jax.random.randint(key, (), 0, 3))(draws[:, 1])
        next_features = said.features[jnp.arange(BATCH), member]
        value = call(old, "judge", next_features)[0]
        reward = said.reward.mean(axis=1) - 0.7 * spread
        imagined.append((features, taken, reward + DISCOUNT * goes_on * value, alive))
        features, alive = next_features, alive * goes_on

    def loss(params):
        total = of_data(params)
        for features, taken, returns, alive in imagined:
            value, *qs = call(params, "judge", features)
            logits, least = call(params, "logits", features), least_of(features, taken)
            each = alive * iql_loss(value, qs, least, logits, returns, taken)
            total += 0.5 * each.mean() / 2
        return total

    assert_is(case, loss)


def test_cql():
    case = make_case(cql, cql.Settings(discount=DISCOUNT, alpha=0.7))
    steps, say = around(case.batch), many(case.setup.make_policy(("q", CHOICES)))
    later, held = (say(of, steps.after)["q"] for of in (case.state.params, case.state.extra))
    target = steps.returned(at(held, later.argmax(axis=-1)))

    def loss(params):
        q = say(params, steps.earlier)["q"]
        each = huber(target - at(q, steps.taken)) + 0.7 * cross_entropy(q, steps.taken)
        return mean(each, steps.known)

    assert_is(case, loss)


def test_qr_dqn():
    count = 3
    case = make_case(qr_dqn, qr_dqn.Settings(discount=DISCOUNT, quantiles=count))
    steps = around(case.batch)
    apply = many(case.setup.make_policy(("q", CHOICES * count)))

    def say(params, contexts):
        """[B, P, N, 2]."""
        said = apply(params, contexts)["q"]
        return said.reshape(*said.shape[:2], CHOICES, count).swapaxes(2, 3)

    held = say(case.state.extra, steps.after)
    best = jnp.broadcast_to(held.mean(axis=2).argmax(axis=-1)[..., None], held.shape[:3])
    values = at(held, best)  # [B, P, N]
    targets = [steps.returned(values[..., place]) for place in range(count)]

    def loss(params):
        q, total = say(params, steps.earlier), 0.0
        for place in range(count):
            estimate = at(q[:, :, place], steps.taken)
            for target in targets:
                error = target - estimate
                share = (place + 0.5) / count
                total += jnp.where(error < 0, 1 - share, share) * huber(error) / count
        return mean(total, steps.known)

    assert_is(case, loss)


def test_rem():
    count = 3
    case = make_case(rem, rem.Settings(discount=DISCOUNT, q_heads=count))
    steps = around(case.batch)
    apply = many(case.setup.make_policy(("q", CHOICES * count)))
    mixtures = jnp.stack([rem.draw_mixture(key, count) for key in DRAWS])

    def say(params, contexts):
        """[B, P, 2]: each example's own mixture."""
        said = apply(params, contexts)["q"].reshape(BATCH, PAST + 1, CHOICES, count)
        return (said * mixtures[:, None, None]).sum(axis=-1)

    highest = say(case.state.extra, steps.after).max(axis=-1)
    target = steps.returned(highest)

    def loss(params):
        difference = target - at(say(params, steps.earlier), steps.taken)
        return mean(huber(difference), steps.known)

    assert_is(case, loss)


def test_plate():
    """Past an end nothing is chosen, and no state is predicted; those it predicts do not move."""
    horizon = 4
    case = make_case(plate, plate.Settings(state_weight=0.6), mixed.DOMAIN, horizon)
    actions, setup = case.batch.actions, case.setup
    module = plate.AlternatingModel(setup.model, setup.sizes, setup.make_encoder())
    call = caller(module)

    def unrolled(params):
        tokens = module.apply(params, case.batch.context, method="encode_batch")
        return call(params, "encode_unrolled", case.batch.context, tokens)

    reached = unrolled(case.state.params)[0][:, 1 - horizon :]
    ends = [[int(action) == toy.END for action in plan] for plan in actions]
    chosen = jnp.array([[not any(plan[:place]) for place in range(horizon)] for plan in ends])
    acted = jnp.array([[not any(plan[: place + 1]) for place in range(horizon)] for plan in ends])
    acted = acted[:, :-1]
    assert not chosen.all() and chosen.all(axis=1).any()

    def loss(params):
        states, between = unrolled(params)
        logits, led = call(params, "read", states, between)
        errors = jnp.where(acted, ((led - reached) ** 2).mean(axis=-1), 0).sum(axis=1)
        errors = errors / jnp.maximum(acted.sum(axis=1), 1)
        return mean(cross_entropy(logits, actions), chosen) + 0.6 * errors.mean()

    assert_is(case, loss)
