"""The paper's other energy: an LSTM that says how corrupted a plan is (appendix, ablation).

Trained on plans some of whose actions were replaced; a plan without a replaced action has
the least energy. Planning with it works worse than with the masked language model.
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
    """The classifier as an `Agent`; it has no use for the transformer's settings."""
    sizes = setup.sizes
    module = SequenceClassifier(setup.model, sizes, setup.make_encoder())
    optimizer = make_optimizer(setup.training)

    def encode(params: Params, context: Context) -> PyTree:
        return module.apply(params, context, method="encode")

    def degree(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        result = module.apply(params, memory, actions, method="degree")
        assert isinstance(result, jax.Array)
        # As for every energy: the end action, the last one, is never the first of a plan.
        return jnp.where(actions[0] == sizes.num_actions - 1, jnp.inf, result)

    energy = classifier(make_encode(setup, encode), degree, sizes.num_actions)

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Squared error of the degree of corruption of one corrupted window."""
        del extra
        corrupted, target = corrupt(key, window.actions, window.imitated, sizes.num_actions)
        memory = module.apply(params, window.context, tokens, method="encode")
        found = module.apply(params, memory, corrupted, method="degree")
        assert isinstance(found, jax.Array)
        return (found - target) ** 2, {"absolute_error": jnp.abs(found - target)}

    mean_loss = average_loss(setup, window_loss, make_window_encoder(module))
    update = make_update(mean_loss, optimizer, mesh)
    init = make_init(setup, module, _encode_and_judge, optimizer)
    return Agent(init, window_batches(setup), update, energy)


def corrupt(
    key: jax.Array, actions: jax.Array, imitated: jax.Array, num_actions: int
) -> tuple[jax.Array, jax.Array]:
    """Replaces n of the actions `[T]` by others, n uniform in 0 .. T; and how corrupted they are.

    The paper says "depending on the degree of randomness": the share of actions that are
    not the demonstrator's. Nor are those his that are not `imitated [T]`.
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
    """Touches every parameter, to initialise them."""
    return module.degree(module.encode(context), actions)


CLASSIFIER = Method(Settings, make_agent)
