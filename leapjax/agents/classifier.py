"""The paper's other energy: an LSTM that estimates how corrupted a plan is (appendix, ablation).

It trains on plans in which some actions are replaced; a plan without replaced actions has the least
energy. Its plans are worse than the masked language model's.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.agents.acting import make_encode
from leapjax.agents.base import Method, Setup
from leapjax.agents.batch_loss import average_loss, make_window_encoder
from leapjax.agents.batches import window_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.update import make_init, make_update
from leapjax.energy import classifier
from leapjax.models.lstm import SequenceClassifier
from leapjax.types import Agent, Context, Params, PyTree, Window


@dataclasses.dataclass(frozen=True)
class Settings:
    """The classifier has no options of its own."""


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a classifier agent; it uses only the width of the model's settings."""
    sizes = setup.sizes
    module = SequenceClassifier(setup.model, sizes, setup.make_encoder())
    optimizer = make_optimizer(setup.training)

    def encode(params: Params, context: Context) -> PyTree:
        return module.apply(params, context, method="encode")

    def degree(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        result = module.apply(params, memory, actions, method="degree")
        assert isinstance(result, jax.Array)
        # As in every energy, the end action (the last one) is never the first of a plan.
        return jnp.where(actions[0] == sizes.num_actions - 1, jnp.inf, result)

    energy = classifier(make_encode(setup, encode), degree, sizes.num_actions)

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Corrupts a window, and returns the squared error of its degree of corruption."""
        del extra
        corrupted, target = corrupt(key, window.actions, window.imitated, sizes.num_actions)
        memory = module.apply(params, window.context, tokens, method="encode")
        estimate = module.apply(params, memory, corrupted, method="degree")
        assert isinstance(estimate, jax.Array)
        return (estimate - target) ** 2, {"absolute_error": jnp.abs(estimate - target)}

    mean_loss = average_loss(setup, window_loss, make_window_encoder(module))
    update = make_update(mean_loss, optimizer, mesh)
    init = make_init(setup, module, _encode_and_judge, optimizer)
    return Agent(init, window_batches(setup), update, energy)


def corrupt(
    key: jax.Array, actions: jax.Array, imitated: jax.Array, num_actions: int
) -> tuple[jax.Array, jax.Array]:
    """Replaces n actions of a plan by others, with n uniform in 0 .. T.

    The degree of corruption is the share of actions that are not the demonstrator's. (The paper
    says "depending on the degree of randomness".)

    Args:
        key: random key.
        actions: plan `[T]`.
        imitated: booleans `[T]`, True where the action is the demonstrator's.
        num_actions: A.

    Returns:
        The corrupted plan `[T]`, and its degree of corruption `[]`.
    """
    count_key, order_key, action_key = jax.random.split(key, 3)
    horizon = actions.shape[0]
    count = jax.random.randint(count_key, (), 0, horizon + 1)
    replaced = jax.random.permutation(order_key, horizon) < count
    # A shift by 1 .. A-1 is always another action.
    shift = jax.random.randint(action_key, (horizon,), 1, max(num_actions, 2))
    corrupted = jnp.where(replaced, (actions + shift) % num_actions, actions)
    foreign = ~imitated & ~replaced
    return corrupted, count / horizon + foreign.sum() / horizon


def _encode_and_judge(
    module: SequenceClassifier, context: Context, actions: jax.Array
) -> jax.Array:
    """Uses every parameter, so that `make_init` initialises all of them."""
    return module.degree(module.encode(context), actions)


CLASSIFIER = Method(Settings, make_agent)
