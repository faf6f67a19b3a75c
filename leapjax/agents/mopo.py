"""Model-based offline policy optimisation for discrete actions (MOPO; Yu et al., 2020).

An ensemble learns what a step leads to. A policy, here IQL's as in the paper (appendix), learns
from the data and from steps that are only imagined, whose reward is less by as much as the
ensemble disagrees: where the data say nothing, nothing is to be gained.

States are imagined as features of the network, not as observations, so any domain will do: the
ensemble predicts the features that a slowly following target network has of the next state. What
shapes them are the values and the imitation of the data; the policy only reads them, because its
weighted gradients would drown the rest.
"""

import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax.agents import iql, losses
from leapjax.agents.acting import make_acting_energy, make_encode_next
from leapjax.agents.base import Method, Setup
from leapjax.agents.batch_loss import average_loss
from leapjax.agents.batches import transition_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.update import apply_to_context, follow_parameters, make_init, make_update
from leapjax.checks import LARGEST, check_at_least, check_within
from leapjax.models.policy import PolicyModel, Said
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


@dataclasses.dataclass(frozen=True)
class Settings(iql.Settings):
    """The options of MOPO, and those of the IQL that it trains.

    Attributes:
        members: Dynamics models in the ensemble.
        rollout: Steps to imagine from the current state of each context.
        penalty: Weight of the ensemble's disagreement, which is taken off imagined rewards.
        real_share: Share of the loss that is of the data; the rest is of imagined steps.
    """

    members: int = 5
    rollout: int = 1
    penalty: float = 1.0
    real_share: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, 2, "members", most=100)
        check_at_least(self, 1, "rollout", most=1000)
        check_within(self, 0, 1, "real_share")
        check_within(self, 0, LARGEST, "penalty")


class Predicted(NamedTuple):
    """What each of M members expects of a step, at P states."""

    features: jax.Array  # [M, P, D] of the state that it leads to
    reward: jax.Array  # [M, P]
    ending: jax.Array  # [M, P] logits: that the episode comes to its end


class Networks(nn.Module):
    """Features of states, and all that is said of features."""

    trunk: PolicyModel  # says features
    choices: int
    members: int

    def setup(self) -> None:  # noqa: D102
        width = self.trunk.config.width
        self.norm = nn.LayerNorm(use_scale=False, use_bias=False)
        self.policy = _Perceptron(self.choices, width)
        self.cloned = _Perceptron(self.choices, width)
        self.value = _Perceptron(1, width)
        self.q = [_Perceptron(self.choices, width) for _ in range(2)]
        ensemble = nn.vmap(
            _Perceptron, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=None,
            axis_size=self.members,
        )  # fmt: skip
        self.dynamics = ensemble(width + 2, 2 * width)

    def __call__(self, context: Context) -> PyTree:
        """Touches every parameter, to initialise them."""
        features = self.features(context)
        actions = jnp.zeros(features.shape[0], jnp.int32)
        said = self.logits(features), self.behaviour(features)
        return self.judge(features), said, self.predict(features, actions)

    def features(self, context: Context) -> jax.Array:
        """Of the last P states, `[P, D]`, of variance 1 each: errors in them have a scale."""
        return self.norm(self.trunk(context)["features"])

    def act(self, context: Context, tokens: jax.Array | None = None) -> Said:
        """The policy's logits, `[P, A - 1]`, given the tokens of the context or not."""
        return {"logits": self.logits(self.norm(self.trunk(context, tokens=tokens)["features"]))}

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the tokens of a context, given those of its past states."""
        return self.trunk.encode_next(context, known)

    def encode_transitions(self, contexts: Context) -> tuple[jax.Array, jax.Array]:
        """Returns the tokens before and after the steps of transitions."""
        return self.trunk.encode_transitions(contexts)

    def transition(
        self, context: Context, tokens: tuple[jax.Array, jax.Array], deterministic: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """Features `[P, D]` before and after the step of a transition."""
        now, later = self.trunk.transition(context, tokens, deterministic)
        return self.norm(now["features"]), self.norm(later["features"])

    def logits(self, features: jax.Array) -> jax.Array:
        """The policy's, `[P, A - 1]`; no gradient flows to the features."""
        return self.policy(jax.lax.stop_gradient(features))

    def behaviour(self, features: jax.Array) -> jax.Array:
        """Logits `[P, A - 1]` of what the data do."""
        return self.cloned(features)

    def judge(self, features: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The value `[P]`, and two Q-values `[P, A - 1]`."""
        first, second = (q(features) for q in self.q)
        return self.value(features)[:, 0], first, second

    def predict(self, features: jax.Array, actions: jax.Array) -> Predicted:
        """What each member expects of actions `[P]`."""
        chosen = jax.nn.one_hot(actions, self.choices)
        said = self.dynamics(jnp.concatenate([features, chosen], axis=1))  # [M, P, D + 2]
        return Predicted(features + said[..., :-2], said[..., -2], said[..., -1])


class _Perceptron(nn.Module):
    """Two layers."""

    features: int
    hidden: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return nn.Dense(self.features)(nn.gelu(nn.Dense(self.hidden)(x)))


def disagreement(predicted: Predicted) -> jax.Array:
    """How much members differ about a step, `[P]`.

    Their standard deviation about the reward, and the root mean square of those about features.
    """
    features = jnp.sqrt(predicted.features.var(axis=0).mean(axis=-1))
    return features + predicted.reward.std(axis=0)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """MOPO as an `Agent`; its energy is minus the policy's logits."""
    settings, choices = setup.settings, setup.domain.num_actions - 1  # the end is not chosen
    trunk = setup.make_policy(("features", setup.model.width))
    module = Networks(trunk, choices, settings.members)
    optimizer = make_optimizer(setup.training)

    def call(params: Params, method: str, *inputs: Any, **options: Any) -> Any:
        return module.apply(params, *inputs, method=method, **options)

    def improve(
        params: Params,
        target: Params,
        features: jax.Array,
        target_features: jax.Array,
        taken: jax.Array,
        returns: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """IQL's losses `[P]` of actions that were taken, given what they returned; the values.

        States are given twice, as the network sees them and as its target does, `[P, D]` each.
        """
        value, *qs = call(params, "judge", features)
        held = call(target, "judge", target_features)[1:]
        least = jnp.minimum(*(losses.of_action(q, taken) for q in held))
        logits = call(params, "logits", features)
        return iql.loss(settings, value, qs, least, logits, taken, returns), value

    def imagine(
        params: Params, target: Params, features: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The mean loss of a rollout from features `[P, D]`, and its mean disagreement."""

        def step(
            carry: tuple[jax.Array, jax.Array], step_key: jax.Array
        ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
            features, alive = carry
            action_key, member_key = jax.random.split(step_key)
            logits = jax.lax.stop_gradient(call(params, "logits", features))
            taken = jax.random.categorical(action_key, logits)
            predicted = jax.lax.stop_gradient(call(params, "predict", features, taken))
            differ = disagreement(predicted)
            rewards = predicted.reward.mean(axis=0) - settings.penalty * differ
            goes_on = 1 - jax.nn.sigmoid(predicted.ending).mean(axis=0)
            member = jax.random.randint(member_key, (), 0, settings.members)
            after = predicted.features[member]
            later = jax.lax.stop_gradient(call(params, "judge", after)[0])
            returns = rewards + settings.discount * goes_on * later
            loss, _ = improve(params, target, features, features, taken, returns)
            return (after, alive * goes_on), ((alive * loss).mean(), (alive * differ).mean())

        start = features, jnp.ones(features.shape[0])
        keys = jax.random.split(key, settings.rollout)
        _, (found, differ) = jax.lax.scan(step, start, keys)
        return found.mean(), differ.mean()

    def say(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return call(params, "act", context, tokens)

    def encode(params: Params, target: Params, batch: TransitionWindow) -> PyTree:
        """Tokens of the network and of its target, before and after the steps."""
        return tuple(call(p, "encode_transitions", batch.context) for p in (params, target))

    def transition_loss(
        params: Params,
        target: Params,
        transition: TransitionWindow,
        tokens: PyTree,
        key: jax.Array,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Of the policy on the data and on what is imagined, and of the ensemble."""
        context = transition.context
        drop_key, rollout_key = jax.random.split(key)
        options = {"deterministic": False, "rngs": {"dropout": drop_key}}
        mine, held = tokens
        now, later = call(params, "transition", context, mine, **options)
        seen, seen_later = call(target, "transition", context, held)
        taken, known = losses.last_actions(context, len(now), choices)
        rewards = context.rewards[-len(now) :]

        values = call(params, "judge", later)[0]
        returns = losses.bellman(transition, values, settings.discount)
        real, value = improve(params, target, now, seen, taken, returns)

        predicted = call(params, "predict", seen, taken)
        ending = jnp.zeros(len(now)).at[-1].set(transition.terminated)
        ensemble = (
            ((predicted.features - seen_later) ** 2).mean(axis=-1)
            + (predicted.reward - rewards) ** 2
            + optax.losses.sigmoid_binary_cross_entropy(predicted.ending, ending)
        ).sum(axis=0)

        imagined, differ = imagine(params, target, seen[-1:], rollout_key)
        cloning, accuracy = losses.imitation(call(params, "behaviour", now), taken, known)
        share = settings.real_share
        of_data = losses.mean_where(share * real + ensemble, known)
        loss = of_data + (1 - share) * imagined + cloning
        return loss, {
            "accuracy": accuracy,
            "value": losses.mean_where(value, known),
            "ensemble": losses.mean_where(ensemble, known),
            "disagreement": differ,
        }

    init = make_init(setup, module, apply_to_context, optimizer, target=lambda params: params)
    mean_loss = average_loss(setup, transition_loss, encode)
    update = make_update(mean_loss, optimizer, mesh, follow_parameters(settings.target_rate))
    energy = make_acting_energy(setup, say)
    encode_next = make_encode_next(setup, module, say)
    return Agent(init, transition_batches(setup), update, energy, encode_next)


MOPO = Method(Settings, make_agent, rewards=True)
