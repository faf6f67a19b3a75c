"""What methods share that learn Q-values from transitions alone, and act by the highest."""

import dataclasses
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
from leapjax.checks import check_types, check_within
from leapjax.data import windows
from leapjax.models.policy import PolicyModel, Said
from leapjax.types import Agent, Context, Params, PyTree, TransitionWindow


@dataclasses.dataclass(frozen=True)
class Settings:
    """The options of each of them.

    The originals copy the network to the target network every few thousand steps: 8,000 in Agarwal
    et al., 2,000 in d3rlpy.

    Attributes:
        discount: Discount of rewards per step.
        target_rate: How far the target network moves towards the network at each step, in 0 .. 1.
    """

    discount: float = 0.99
    target_rate: float = 0.005

    def __post_init__(self) -> None:
        check_types(self)
        check_within(self, 0, 1, "discount", "target_rate")


class Judged(NamedTuple):
    """A step that was taken, and the W numbers that networks say of the states around it."""

    now: jax.Array  # [P, W] before the step
    later: jax.Array  # [P, W] after it
    held: jax.Array  # [P, W] after it, by the target network
    taken: jax.Array  # [P] int32: the action


def encode_around(module: PolicyModel) -> EncodeExamples:
    """Encodes the contexts before and after the steps of transitions, for `look_around`."""

    def encode(params: Params, target: Params, batch: TransitionWindow) -> PyTree:
        after = jax.vmap(windows.after)(batch.context)
        return (
            module.apply(params, batch.context, method="encode_transitions"),
            module.apply(target, after, method="encode_batch"),
        )

    return encode


def look_around(
    module: PolicyModel,
    params: Params,
    target: Params,
    context: Context,
    tokens: PyTree,
    key: jax.Array,
) -> tuple[Said, Said, Said]:
    """What is said before and after the step of a transition, and after it by the target network.

    Args:
        module: the network.
        params: its parameters.
        target: those of the target network.
        context: of the transition.
        tokens: of the transition, from `encode_around`.
        key: of dropout; the target network has none.
    """
    around, after = tokens
    said: Any = module.apply(
        params, context, around, deterministic=False, rngs={"dropout": key}, method="transition"
    )
    held: Any = module.apply(target, windows.after(context), tokens=after)
    return *said, held


Returns = Callable[[jax.Array], jax.Array]
# values of the states after a step, [P] or [P, N] -> targets of the same shape: `losses.bellman`
Loss = Callable[[Judged, Returns, jax.Array], jax.Array]  # (judged, returns, key) -> [P]


def make_agent(
    setup: Setup,
    mesh: Mesh | None,
    width: int,
    loss: Loss,
    values: Callable[[jax.Array], jax.Array],
) -> Agent:
    """An `Agent` whose energy is minus its Q-values.

    Args:
        setup: what it is made from.
        mesh: of devices to train on; None for one.
        width: W, how many numbers its network says of a state.
        loss: of each step.
        values: of what is said, `[P, W]`: the Q-values, `[P, A - 1]`.
    """
    settings, choices = setup.settings, setup.domain.num_actions - 1  # the end is not chosen
    module = setup.make_policy(("q", width))
    optimizer = make_optimizer(setup.training)

    def say(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
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
        said = look_around(module, params, target, context, tokens, dropout_key)
        now, later, held = (each["q"] for each in said)
        taken, known = losses.last_actions(context, len(now), choices)

        def returns(values: jax.Array) -> jax.Array:
            return losses.bellman(transition, values, settings.discount)

        each = loss(Judged(now, later, held, taken), returns, loss_key)
        q = values(now)
        return losses.mean_where(each, known), {
            "accuracy": losses.mean_where(jnp.argmax(q, axis=1) == taken, known),
            "value": losses.mean_where(losses.of_action(q, taken), known),
        }

    init = make_init(setup, module, apply_to_context, optimizer, target=lambda params: params)
    mean_loss = average_loss(setup, transition_loss, encode_around(module))
    update = make_update(mean_loss, optimizer, mesh, follow_parameters(settings.target_rate))
    energy = make_acting_energy(setup, say, lambda said: values(said["q"]))
    encode_next = make_encode_next(setup, module, say)
    return Agent(init, transition_batches(setup), update, energy, encode_next)
