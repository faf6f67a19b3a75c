"""Model-based offline policy optimisation for discrete actions (MOPO; Yu et al., 2020).

An ensemble learns to predict steps. A policy, here IQL's as in the paper (appendix), learns from
the data and from imagined steps. The ensemble's disagreement lowers the reward of an imagined step,
so the policy stays near the data.

The ensemble predicts features of the network instead of observations, so it works in every domain.
Its targets are the features of the next state in a slowly moving target network. The losses of
values and of imitation train the features. The policy's loss does not train them, because its
weighted gradients are much larger.
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
from leapjax.models.policy import Outputs, PolicyModel
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


@dataclasses.dataclass(frozen=True)
class Settings(iql.Settings):
    """The options of MOPO, in addition to the options of IQL.

    Attributes:
        members: Dynamics models in the ensemble.
        rollout: Steps to imagine from the current state of each context.
        penalty: Weight of the ensemble's disagreement, subtracted from imagined rewards.
        real_share: Weight of the loss on data, in 0 .. 1; imagined steps have the other weight.
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
    """The predictions of M ensemble members for one step from each of P states.

    Attributes:
        features: features `[M, P, D]` of the next states.
        reward: rewards `[M, P]`.
        ending: logits `[M, P]` that the episode ends with the step.
    """

    features: jax.Array
    reward: jax.Array
    ending: jax.Array


class Networks(nn.Module):
    """Features of states, and perceptrons that read them.

    Attributes:
        trunk: network with the head "features".
        choices: A - 1, number of actions without the end.
        members: M, number of dynamics models.
    """

    trunk: PolicyModel
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
        """Uses every parameter, so that `make_init` initialises all of them."""
        features = self.features(context)
        actions = jnp.zeros(features.shape[0], jnp.int32)
        logits = self.logits(features), self.behaviour(features)
        return self.judge(features), logits, self.predict(features, actions)

    def features(self, context: Context) -> jax.Array:
        """Returns features `[P, D]` of the last P states, normalised to variance 1."""
        return self.norm(self.trunk(context)["features"])

    def act(self, context: Context, tokens: jax.Array | None = None) -> Outputs:
        """Returns the policy's logits `[P, A - 1]`.

        Args:
            context: context to act from.
            tokens: encoder's tokens; if `None`, the network encodes the context.
        """
        return {"logits": self.logits(self.norm(self.trunk(context, tokens=tokens)["features"]))}

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the tokens of a context, given the tokens of its past states."""
        return self.trunk.encode_next(context, known)

    def encode_transitions(self, contexts: Context) -> tuple[jax.Array, jax.Array]:
        """Returns the tokens before and after the steps of transitions."""
        return self.trunk.encode_transitions(contexts)

    def apply_transition(
        self, context: Context, tokens: tuple[jax.Array, jax.Array], deterministic: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """Returns features `[P, D]` before and after the step of a transition."""
        before, after = self.trunk.apply_transition(context, tokens, deterministic)
        return self.norm(before["features"]), self.norm(after["features"])

    def logits(self, features: jax.Array) -> jax.Array:
        """Returns the policy's logits `[P, A - 1]`; the features get no gradient."""
        return self.policy(jax.lax.stop_gradient(features))

    def behaviour(self, features: jax.Array) -> jax.Array:
        """Returns logits `[P, A - 1]` of the data's actions."""
        return self.cloned(features)

    def judge(self, features: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns the value `[P]`, and two Q-values `[P, A - 1]`."""
        first, second = (q(features) for q in self.q)
        return self.value(features)[:, 0], first, second

    def predict(self, features: jax.Array, actions: jax.Array) -> Predicted:
        """Predicts with each member the steps that actions `[P]` take from P states."""
        chosen = jax.nn.one_hot(actions, self.choices)
        steps = self.dynamics(jnp.concatenate([features, chosen], axis=1))  # [M, P, D + 2]
        return Predicted(features + steps[..., :-2], steps[..., -2], steps[..., -1])


class _Perceptron(nn.Module):
    """A perceptron with one hidden layer."""

    features: int
    hidden: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return nn.Dense(self.features)(nn.gelu(nn.Dense(self.hidden)(x)))


def measure_disagreement(predicted: Predicted) -> jax.Array:
    """Measures how much the members' predictions differ, `[P]`.

    It is the standard deviation of the rewards, plus the root mean square over features of their
    standard deviations.
    """
    features = jnp.sqrt(predicted.features.var(axis=0).mean(axis=-1))
    return features + predicted.reward.std(axis=0)


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a MOPO agent; its energy is minus the policy's logits."""
    settings, choices = setup.settings, setup.domain.num_actions - 1  # all but the end
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
        """Computes IQL's losses `[P]` of actions, and the values `[P]` of their states.

        Args:
            params: parameters of the network.
            target: parameters of the target network.
            features: the network's features `[P, D]` of the states.
            target_features: the target network's features `[P, D]` of the states.
            taken: actions `[P]`.
            returns: Bellman targets `[P]` of the actions.
        """
        value, *qs = call(params, "judge", features)
        target_qs = call(target, "judge", target_features)[1:]
        least = jnp.minimum(*(losses.select_values(q, taken) for q in target_qs))
        logits = call(params, "logits", features)
        return iql.compute_losses(settings, value, qs, least, logits, taken, returns), value

    def imagine(
        params: Params, target: Params, features: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Imagines a rollout from features `[P, D]`; returns its mean loss and disagreement."""

        def step(
            carry: tuple[jax.Array, jax.Array], step_key: jax.Array
        ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
            features, alive = carry
            action_key, member_key = jax.random.split(step_key)
            logits = jax.lax.stop_gradient(call(params, "logits", features))
            taken = jax.random.categorical(action_key, logits)
            predicted = jax.lax.stop_gradient(call(params, "predict", features, taken))
            differ = measure_disagreement(predicted)
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
        _, (each_loss, differ) = jax.lax.scan(step, start, keys)
        return each_loss.mean(), differ.mean()

    def apply(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return call(params, "act", context, tokens)

    def encode(params: Params, target: Params, batch: TransitionWindow) -> PyTree:
        """Encodes the states before and after the steps, with the network and its target."""
        return tuple(call(p, "encode_transitions", batch.context) for p in (params, target))

    def transition_loss(
        params: Params,
        target: Params,
        transition: TransitionWindow,
        tokens: PyTree,
        key: jax.Array,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Sums IQL's losses on data and imagined steps, the ensemble's loss, and imitation's."""
        context = transition.context
        drop_key, rollout_key = jax.random.split(key)
        options = {"deterministic": False, "rngs": {"dropout": drop_key}}
        own_tokens, target_tokens = tokens
        before, after = call(params, "apply_transition", context, own_tokens, **options)
        target_before, target_after = call(target, "apply_transition", context, target_tokens)
        taken, known = losses.find_transition_actions(context, len(before), choices)
        rewards = context.rewards[-len(before) :]

        values = call(params, "judge", after)[0]
        returns = losses.bellman_targets(transition, values, settings.discount)
        real, value = improve(params, target, before, target_before, taken, returns)

        predicted = call(params, "predict", target_before, taken)
        ending = jnp.zeros(len(before)).at[-1].set(transition.terminated)
        ensemble = (
            ((predicted.features - target_after) ** 2).mean(axis=-1)
            + (predicted.reward - rewards) ** 2
            + optax.losses.sigmoid_binary_cross_entropy(predicted.ending, ending)
        ).sum(axis=0)

        imagined, differ = imagine(params, target, target_before[-1:], rollout_key)
        cloning, accuracy = losses.imitation_loss(call(params, "behaviour", before), taken, known)
        share = settings.real_share
        of_data = losses.average_where(share * real + ensemble, known)
        loss = of_data + (1 - share) * imagined + cloning
        return loss, {
            "accuracy": accuracy,
            "value": losses.average_where(value, known),
            "ensemble": losses.average_where(ensemble, known),
            "disagreement": differ,
        }

    init = make_init(setup, module, apply_to_context, optimizer, target=lambda params: params)
    mean_loss = average_loss(setup, transition_loss, encode)
    update = make_update(mean_loss, optimizer, mesh, follow_parameters(settings.target_rate))
    energy = make_acting_energy(setup, apply)
    encode_next = make_encode_next(setup, module, apply)
    return Agent(init, transition_batches(setup), update, energy, encode_next)


MOPO = Method(Settings, make_agent, rewards=True)
