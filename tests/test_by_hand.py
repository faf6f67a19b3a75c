"""The loss of each method, and its gradient, match a formula.

A formula here is a function of the trained parameters alone. Targets and weights that a method
holds fixed are computed before, so the gradient, too, checks the method.
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
KEYS = jax.vmap(jax.random.fold_in, (None, 0))(KEY, np.arange(BATCH))  # one for each example
LOSS_KEYS = jax.vmap(jax.random.split)(KEYS)[:, 1]  # the other halves are for dropout
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
    """Makes a case with a batch of mixed steps (horizon 1) or of demonstrated plans."""
    learn = TrainingConfig(batch=BATCH, windows="step")
    setup = Setup(domain, PAST, horizon, MODEL, learn, settings)
    agent = module.make_agent(setup)
    state = random_like(jax.eval_shape(agent.init, jax.random.key(0)))
    data = mixed.steps() if horizon == 1 else windows.concatenate(toy.demonstrations())
    batch = quick_jit(agent.batch)(jax.random.key(3), jax.tree.map(jnp.asarray, data))
    return Case(setup, agent, state, batch)


def check_loss(case, loss):
    """Checks the agent's loss and the norm of its gradient against a function of parameters.

    A target network, of all parameters or of the critic's, must follow them slowly.
    """
    after, found = quick_jit(case.agent.update)(case.state, case.batch, KEY)
    if hasattr(case.setup.settings, "target_rate"):
        online, rate = after.params, case.setup.settings.target_rate
        if "critic" in online["params"]:
            online = {"params": online["params"]["critic"]}
        expected = optax.incremental_update(online, case.state.extra, rate)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
            after.extra, expected,
        )  # fmt: skip
    expected, gradient = quick_jit(jax.value_and_grad(loss))(case.state.params)
    assert float(found["loss"]) == pytest.approx(float(expected), rel=1e-4)
    norm = float(optax.tree.norm(gradient))
    assert float(found["gradient_norm"]) == pytest.approx(norm, rel=1e-3)


class Steps(NamedTuple):
    """Steps [B, P], and the contexts before and after the last step."""

    earlier: object
    after: object
    taken: jax.Array
    rewards: jax.Array
    continues: jax.Array
    known: jax.Array  # False before the episode

    def bootstrap(self, value):
        """Returns rewards plus the discounted values [B, P] of the next states."""
        return self.rewards + DISCOUNT * self.continues * value


def make_steps(batch):
    earlier, after = (jax.vmap(f)(batch.context) for f in (windows.before, windows.after))
    known = batch.context.actions < CHOICES
    assert batch.terminated.any() and not known.all() and known[:, -1].all()
    return Steps(
        earlier, after, jnp.where(known, batch.context.actions, 0), batch.context.rewards,
        jnp.ones(known.shape).at[:, -1].set(1.0 - batch.terminated), known,
    )  # fmt: skip


def mean(values, known):
    """Averages over the known steps [P] of each example, then over examples."""
    return (jnp.where(known, values, 0).sum(axis=1) / known.sum(axis=1)).mean()


def at(values, index):
    return jnp.take_along_axis(values, index[..., None], axis=-1)[..., 0]


def huber(errors):
    size = jnp.abs(errors)
    return jnp.where(size <= 1, size**2 / 2, size - 1 / 2)


def cross_entropy(logits, taken):
    return jax.nn.logsumexp(logits, axis=-1) - at(logits, taken)


def make_call(module):
    """Returns (parameters, method, *inputs) -> the outputs for a batch."""

    def call(params, method, *inputs):
        apply = functools.partial(module.apply, method=method)
        return jax.vmap(apply, (None, *(0 for _ in inputs)))(params, *inputs)

    return call


def batched(module):
    """Returns (parameters, contexts) -> the outputs of `__call__` for a batch."""
    call = make_call(module)
    return jax.jit(lambda params, contexts: call(params, "__call__", contexts))


def test_bc_loss_matches_its_formula():
    """The loss covers every state of a context since the episode began."""
    case = make_case(bc, bc.Settings())
    encode = jax.vmap(case.agent.energy.encode, (None, 0))
    actions = jnp.concatenate([case.batch.context.actions, case.batch.actions], axis=1)
    known = actions < CHOICES
    assert not known.all()

    def loss(params):
        logits = encode(params, case.batch.context)["logits"]
        return mean(cross_entropy(logits, jnp.where(known, actions, 0)), known)

    check_loss(case, loss)


def test_classifier_loss_matches_its_formula():
    case = make_case(classifier, classifier.Settings(), mixed.DOMAIN, horizon=4)
    setup, batch = case.setup, case.batch
    call = make_call(classifier.SequenceClassifier(setup.model, setup.sizes, setup.make_encoder()))
    corrupt = functools.partial(classifier.corrupt, num_actions=toy.DOMAIN.num_actions)
    corrupted, degrees = quick_jit(jax.vmap(corrupt))(KEYS, batch.actions, batch.imitated)

    def loss(params):
        found = call(params, "degree", call(params, "encode", batch.context), corrupted)
        return ((found - degrees) ** 2).mean()

    check_loss(case, loss)
    assert not case.agent.energy.accepts_mask


def test_bcq_loss_matches_its_formula():
    case = make_case(bcq, bcq.Settings(discount=DISCOUNT, threshold=0.9))
    steps = make_steps(case.batch)
    evaluate = batched(case.setup.make_policy(("q", CHOICES), ("behaviour", CHOICES)))
    later, frozen = (evaluate(x, steps.after) for x in (case.state.params, case.state.extra))
    likely = jax.nn.softmax(later["behaviour"])
    likely = likely / likely.max(axis=-1, keepdims=True) >= 0.9
    best = jnp.where(likely, later["q"], -jnp.inf).argmax(axis=-1)
    assert (best != later["q"].argmax(axis=-1)).any()
    target = steps.bootstrap(at(frozen["q"], best))

    def loss(params):
        now = evaluate(params, steps.earlier)
        difference = huber(target - at(now["q"], steps.taken))
        imitation = cross_entropy(now["behaviour"], steps.taken)
        squares = (now["behaviour"] ** 2).mean(axis=-1)
        return mean(difference + 0.01 * squares + imitation, steps.known)

    check_loss(case, loss)


def iql_loss(value, qs, min_q, logits, returns, taken):
    """Computes IQL's loss; `min_q` and `returns` are constants."""
    advantage = min_q - value
    weight = jnp.minimum(jnp.exp(2.0 * jax.lax.stop_gradient(advantage)), 1.5)
    return (
        jnp.where(advantage > 0, 0.8, 0.2) * advantage**2
        + sum((returns - at(q, taken)) ** 2 for q in qs)
        + weight * cross_entropy(logits, taken)
    )


def test_iql_loss_matches_its_formula():
    case = make_case(iql, iql.Settings(**IQL))
    steps, params = make_steps(case.batch), case.state.params["params"]
    critic = batched(case.setup.make_policy(("value", 1), ("q1", CHOICES), ("q2", CHOICES)))
    policy = batched(case.setup.make_policy(("logits", CHOICES)))
    later = critic({"params": params["critic"]}, steps.after)["value"][..., 0]
    returns = steps.bootstrap(later)
    frozen = critic(case.state.extra, steps.earlier)
    min_q = jnp.minimum(at(frozen["q1"], steps.taken), at(frozen["q2"], steps.taken))

    def loss(params):
        now = critic({"params": params["params"]["critic"]}, steps.earlier)
        logits = policy({"params": params["params"]["policy"]}, steps.earlier)["logits"]
        value, qs = now["value"][..., 0], (now["q1"], now["q2"])
        return mean(iql_loss(value, qs, min_q, logits, returns, steps.taken), steps.known)

    check_loss(case, loss)


@only_long
def test_mopo_loss_matches_its_formula():
    """The loss covers the data and imagined rollouts of two steps."""
    settings = mopo.Settings(**IQL, members=3, rollout=2, penalty=0.7, real_share=0.5)
    case = make_case(mopo, settings)
    steps, old, target = make_steps(case.batch), case.state.params, case.state.extra
    call = make_call(mopo.Networks(case.setup.make_policy(("features", WIDTH)), CHOICES, 3))

    encoded, encoded_later = (call(target, "features", x) for x in (steps.earlier, steps.after))
    later = call(old, "judge", call(old, "features", steps.after))[0]
    returns = steps.bootstrap(later)

    def find_min_q(features, taken):
        _, *qs = call(target, "judge", features)
        return jnp.minimum(*(at(q, taken) for q in qs))

    def compute_data_loss(params):
        now = call(params, "features", steps.earlier)
        value, *qs = call(params, "judge", now)
        logits = call(params, "logits", jax.lax.stop_gradient(now))
        policy = iql_loss(value, qs, find_min_q(encoded, steps.taken), logits, returns, steps.taken)
        outputs = call(params, "predict", encoded, steps.taken)  # [B, M, P, ...]
        ends = jnp.zeros(steps.known.shape).at[:, -1].set(case.batch.terminated)[:, None]
        ended = jnp.where(ends > 0, outputs.ending, -outputs.ending)
        ensemble = (
            ((outputs.features - encoded_later[:, None]) ** 2).mean(axis=-1)
            + (outputs.reward - steps.rewards[:, None]) ** 2
            + jnp.logaddexp(0, -ended)
        ).sum(axis=1)
        cloned = cross_entropy(call(params, "behaviour", now), steps.taken)
        return mean(0.5 * policy + ensemble + cloned, steps.known)

    imagined = []  # features [B, 1, D], actions, returns, probabilities that the episode goes on
    features, alive = encoded[:, -1:], jnp.ones((BATCH, 1))
    for step in range(2):
        draws = jax.vmap(lambda key, step=step: jax.random.split(jax.random.split(key, 2)[step]))(
            LOSS_KEYS
        )
        logits = call(old, "logits", features)
        taken = jax.vmap(jax.random.categorical)(draws[:, 0], logits)
        outputs = call(old, "predict", features, taken)
        spread = jnp.sqrt(outputs.features.var(axis=1).mean(axis=-1)) + outputs.reward.std(axis=1)
        continues = 1 - (1 / (1 + jnp.exp(-outputs.ending))).mean(axis=1)
        member = jax.vmap(lambda key: jax.random.randint(key, (), 0, 3))(draws[:, 1])
        next_features = outputs.features[jnp.arange(BATCH), member]
        value = call(old, "judge", next_features)[0]
        reward = outputs.reward.mean(axis=1) - 0.7 * spread
        imagined.append((features, taken, reward + DISCOUNT * continues * value, alive))
        features, alive = next_features, alive * continues

    def loss(params):
        total = compute_data_loss(params)
        for features, taken, returns, alive in imagined:
            value, *qs = call(params, "judge", features)
            logits, min_q = call(params, "logits", features), find_min_q(features, taken)
            each = alive * iql_loss(value, qs, min_q, logits, returns, taken)
            total += 0.5 * each.mean() / 2
        return total

    check_loss(case, loss)


def test_cql_loss_matches_its_formula():
    case = make_case(cql, cql.Settings(discount=DISCOUNT, alpha=0.7))
    steps, evaluate = make_steps(case.batch), batched(case.setup.make_policy(("q", CHOICES)))
    later, frozen = (evaluate(x, steps.after)["q"] for x in (case.state.params, case.state.extra))
    target = steps.bootstrap(at(frozen, later.argmax(axis=-1)))

    def loss(params):
        q = evaluate(params, steps.earlier)["q"]
        each = huber(target - at(q, steps.taken)) + 0.7 * cross_entropy(q, steps.taken)
        return mean(each, steps.known)

    check_loss(case, loss)


def test_qr_dqn_loss_matches_its_formula():
    count = 3
    case = make_case(qr_dqn, qr_dqn.Settings(discount=DISCOUNT, quantiles=count))
    steps = make_steps(case.batch)
    apply = batched(case.setup.make_policy(("q", CHOICES * count)))

    def evaluate(params, contexts):
        """Returns quantiles [B, P, N, 2]."""
        outputs = apply(params, contexts)["q"]
        return outputs.reshape(*outputs.shape[:2], CHOICES, count).swapaxes(2, 3)

    frozen = evaluate(case.state.extra, steps.after)
    best = jnp.broadcast_to(frozen.mean(axis=2).argmax(axis=-1)[..., None], frozen.shape[:3])
    values = at(frozen, best)  # [B, P, N]
    targets = [steps.bootstrap(values[..., i]) for i in range(count)]

    def loss(params):
        q, total = evaluate(params, steps.earlier), 0.0
        for i in range(count):
            estimate = at(q[:, :, i], steps.taken)
            for target in targets:
                error = target - estimate
                share = (i + 0.5) / count
                total += jnp.where(error < 0, 1 - share, share) * huber(error) / count
        return mean(total, steps.known)

    check_loss(case, loss)


def test_rem_loss_matches_its_formula():
    count = 3
    case = make_case(rem, rem.Settings(discount=DISCOUNT, q_heads=count))
    steps = make_steps(case.batch)
    apply = batched(case.setup.make_policy(("q", CHOICES * count)))
    mixtures = jnp.stack([rem.draw_mixture(key, count) for key in LOSS_KEYS])

    def evaluate(params, contexts):
        """Returns Q [B, P, 2]: each example has its own mixture."""
        outputs = apply(params, contexts)["q"].reshape(BATCH, PAST + 1, CHOICES, count)
        return (outputs * mixtures[:, None, None]).sum(axis=-1)

    highest = evaluate(case.state.extra, steps.after).max(axis=-1)
    target = steps.bootstrap(highest)

    def loss(params):
        difference = target - at(evaluate(params, steps.earlier), steps.taken)
        return mean(huber(difference), steps.known)

    check_loss(case, loss)


def test_plate_loss_matches_its_formula():
    """The loss ignores actions and states after the end; the states to predict are constants."""
    horizon = 4
    case = make_case(plate, plate.Settings(state_weight=0.6), mixed.DOMAIN, horizon)
    actions, setup = case.batch.actions, case.setup
    module = plate.AlternatingModel(setup.model, setup.sizes, setup.make_encoder())
    call = make_call(module)

    def unrolled(params):
        tokens = module.apply(params, case.batch.context, method="encode_batch")
        return call(params, "encode_unrolled", case.batch.context, tokens)

    next_states = quick_jit(unrolled)(case.state.params)[0][:, 1 - horizon :]
    ends = [[int(action) == toy.END for action in plan] for plan in actions]
    chosen = jnp.array([[not any(plan[:i]) for i in range(horizon)] for plan in ends])
    acted = jnp.array([[not any(plan[: i + 1]) for i in range(horizon)] for plan in ends])
    acted = acted[:, :-1]
    assert not chosen.all() and chosen.all(axis=1).any()

    def loss(params):
        states, previous_actions = unrolled(params)
        logits, predicted = call(params, "read", states, previous_actions)
        errors = jnp.where(acted, ((predicted - next_states) ** 2).mean(axis=-1), 0).sum(axis=1)
        errors = errors / jnp.maximum(acted.sum(axis=1), 1)
        return mean(cross_entropy(logits, actions), chosen) + 0.6 * errors.mean()

    check_loss(case, loss)
