"""The agent that CQL, QR-DQN and REM share: it learns Q-values, and chooses the highest."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents import losses
from leapjax.agents.acting import make_acting_energy, make_encode_next
from leapjax.agents.base import Setup
from leapjax.agents.batch_loss import EncodeExamples, average_loss
from leapjax.agents.batches import transition_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.update import apply_to_context, follow_parameters, make_init, make_update
from leapjax.data import windows
from leapjax.models.policy import Outputs, PolicyModel
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


class TransitionOutputs(NamedTuple):
    """The network's W outputs at the states of a transition, and its actions.

    Attributes:
        before: outputs `[P, W]` at the P states before the steps.
        after: outputs `[P, W]` at the states after the steps.
        target_after: outputs `[P, W]` of the target network at the states after the steps.
        actions: actions `[P]` of the steps, int32.
    """

    before: jax.Array
    after: jax.Array
    target_after: jax.Array
    actions: jax.Array


def make_transition_encoder(module: PolicyModel) -> EncodeExamples:
    """Makes the `encode` of `average_loss` for transitions; `apply_to_transition` takes its tokens.

    Args:
        module: network.
    """

    def encode(params: Params, target: Params, batch: TransitionWindow) -> PyTree:
        after = jax.vmap(windows.after)(batch.context)
        return (
            module.apply(params, batch.context, method="encode_transitions"),
            module.apply(target, after, method="encode_batch"),
        )

    return encode


def apply_to_transition(
    module: PolicyModel,
    params: Params,
    target: Params,
    context: Context,
    tokens: PyTree,
    key: jax.Array,
) -> tuple[Outputs, Outputs, Outputs]:
    """Applies a network before and after the step of a transition, and the target network after.

    Args:
        module: network.
        params: parameters of the network.
        target: parameters of the target network.
        context: context of the transition.
        tokens: tokens of the transition, from `make_transition_encoder`.
        key: key of the network's dropout; the target network has no dropout.
    """
    around, after = tokens
    outputs: Any = module.apply(
        params, context, around, deterministic=False, rngs={"dropout": key},
        method="apply_transition",
    )  # fmt: skip
    target_after: Any = module.apply(target, windows.after(context), tokens=after)
    return *outputs, target_after


MakeTargets = Callable[[jax.Array], jax.Array]
# values of the states after the steps, [P] or [P, N] -> Bellman targets of the same shape
Loss = Callable[[TransitionOutputs, MakeTargets, jax.Array], jax.Array]
# (outputs, make_targets, key) -> losses [P]


def make_agent(
    setup: Setup,
    mesh: Mesh | None,
    width: int,
    loss: Loss,
    read_values: Callable[[jax.Array], jax.Array],
) -> Agent:
    """Makes an agent whose energy is minus its Q-values.

    Args:
        setup: arguments of a method's `make_agent`.
        mesh: devices to train on; `None` for one device.
        width: W, number of outputs of the network at a state.
        loss: computes the losses `[P]` of a transition's steps.
        read_values: outputs `[P, W]` -> Q-values `[P, A - 1]`.
    """
    settings, choices = setup.settings, setup.domain.num_actions - 1  # all but the end action
    module = setup.make_policy(("q", width))
    optimizer = make_optimizer(setup.training)

    def apply(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, tokens=tokens)

    def transition_loss(
        params: Params,
        target: PyTree,
        transition: TransitionWindow,
        tokens: PyTree,
        key: jax.Array,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        context = transition.context
        dropout_key, loss_key = jax.random.split(key)
        outputs = apply_to_transition(module, params, target, context, tokens, dropout_key)
        before, after, target_after = (each["q"] for each in outputs)
        actions, known = losses.find_transition_actions(context, len(before), choices)

        def make_targets(values: jax.Array) -> jax.Array:
            return losses.bellman_targets(transition, values, settings.discount)

        steps = TransitionOutputs(before, after, target_after, actions)
        each = loss(steps, make_targets, loss_key)
        q = read_values(before)
        return losses.average_where(each, known), {
            "accuracy": losses.average_where(jnp.argmax(q, axis=1) == actions, known),
            "value": losses.average_where(losses.select_values(q, actions), known),
        }

    mean_loss = average_loss(setup, transition_loss, make_transition_encoder(module))
    follow = follow_parameters(settings.target_rate)
    return Agent(
        init=make_init(setup, module, apply_to_context, optimizer, target=lambda params: params),
        batch=transition_batches(setup),
        update=make_update(mean_loss, optimizer, mesh, follow),
        energy=make_acting_energy(setup, apply, lambda outputs: read_values(outputs["q"])),
        encode_next=make_encode_next(setup, module, apply),
    )
