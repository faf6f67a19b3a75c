"""LEAP: train a masked language model on demonstrations, plan by Gibbs sampling."""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax import schedules
from leapjax.agents import returns
from leapjax.agents.acting import make_encode, make_encode_next
from leapjax.agents.base import Method, Setup
from leapjax.agents.batch_loss import average_loss, make_window_encoder
from leapjax.agents.batches import run_batches, window_batches
from leapjax.agents.optimizer import make_optimizer
from leapjax.agents.update import make_init, make_update
from leapjax.checks import check_types
from leapjax.data import windows
from leapjax.energy import pseudo_likelihood
from leapjax.errors import UserError
from leapjax.models.masked import MaskedModel, build_masked_model
from leapjax.types import Agent, Context, Params, PyTree, Window, mask_token, pad_token


@dataclasses.dataclass(frozen=True)
class Settings:
    """The options of LEAP alone.

    Attributes:
        masking: Actions to mask in training: "one", "each", "all", "random" or "stratified". The
            function `leapjax.schedules.sample_masks` explains them.
        end: A plan may end early. If not, what follows the end is padding that nothing predicts.
        repeat_state: Every position sees the whole state (eq. 4). If not, later ones see it without
            the agent's pose.
        returns: Condition plans on the return to go, as Decision Transformer does.
        target_return: Return of an episode that is asked for while acting. It needs `returns`.
    """

    masking: str = "one"
    end: bool = True
    repeat_state: bool = True
    returns: bool = False
    target_return: float = 1.0

    def __post_init__(self) -> None:
        check_types(self)
        if self.masking not in schedules.MASKINGS:
            raise ValueError(
                f"unknown masking {self.masking!r}: expected one of {', '.join(schedules.MASKINGS)}"
            )


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """LEAP as an `Agent`.

    Args:
        setup: what it is made from.
        mesh: of devices to train on (see `leapjax.sharding`); None for one device.
    """
    sizes, masking = setup.sizes, setup.settings.masking
    conditioned = setup.settings.returns
    module = build_masked_model(
        setup.model, sizes, setup.make_encoder(), conditioned, setup.settings.repeat_state
    )
    to_go = returns.condition_on_target(setup) if conditioned else returns.omit_returns
    optimizer = make_optimizer(setup.training)
    mask, pad = mask_token(sizes.num_actions), pad_token(sizes.num_actions)
    last = sizes.num_actions - 1  # the end action

    def allowed(logits: jax.Array) -> jax.Array:
        return logits if setup.settings.end else logits.at[:, last].set(-jnp.inf)

    def encode(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(params, context, returns=to_go(context), tokens=tokens, method="encode")

    def logits(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        result = module.apply(params, memory, actions, positions, method="logits")
        assert isinstance(result, jax.Array)
        return allowed(result)

    energy = pseudo_likelihood(make_encode(setup, encode), logits, sizes.num_actions)

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Masked cross-entropy of one window (paper, equation 1), and its accuracy."""
        del extra
        mask_key, encode_key, *_ = keys = jax.random.split(key, 2 + sizes.horizon)
        masks = schedules.sample_masks(mask_key, sizes.horizon, masking)  # [C, T]
        memory = module.apply(
            params, window.context, deterministic=False, method="encode",
            rngs={"dropout": encode_key}, returns=to_go(window.context, window.return_to_go),
            tokens=tokens,
        )  # fmt: skip

        def score(masked: jax.Array, drop_key: jax.Array) -> tuple[jax.Array, ...]:
            # Only what is masked is predicted: where that is one action, only it is computed.
            single = masking in schedules.SINGLE
            positions = jnp.argmax(masked)[None] if single else jnp.arange(sizes.horizon)
            beyond = (window.actions == last) & (not setup.settings.end)
            masked &= window.imitated  # what is not learned is always shown
            tokens = jnp.where(masked, mask, jnp.where(beyond, pad, window.actions))
            logits = module.apply(
                params, memory, tokens, positions, deterministic=False, method="logits",
                rngs={"dropout": drop_key},
            )  # fmt: skip
            assert isinstance(logits, jax.Array)
            logits, targets = allowed(logits), window.actions[positions]
            likelihoods = jnp.take_along_axis(jax.nn.log_softmax(logits), targets[:, None], axis=1)
            hits = jnp.argmax(logits, axis=1) == targets
            return likelihoods[:, 0], hits, (masked & ~beyond)[positions]

        likelihoods, hits, counted = jax.vmap(score)(masks, keys[2 : 2 + masks.shape[0]])  # [C, P]
        # What is not masked is not predicted: its terms are left out, not zeroed after the
        # fact, so that a -inf there cannot become NaN. Every action that is has the same weight.
        accuracy = jnp.where(counted, hits, 0).sum() / jnp.maximum(counted.sum(), 1)
        return -jnp.where(counted, likelihoods, 0).sum() / masks.sum(), {"accuracy": accuracy}

    def run_loss(
        params: Params, extra: PyTree, run: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The mean of S windows in a row, `[S, ...]`, of which each state is encoded once.

        So a state sees the frames before it even at the front of a window, where those before
        the window are unknown if it is encoded alone (Atari's first three).

        Args:
            params: of the network.
            extra: nothing.
            run: the windows.
            tokens: `[K + S, D]` of their states.
            key: of masks and dropout.
        """
        keys = jax.random.split(key, run.actions.shape[0])

        def loss(window: Window, key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
            place = window.context.step - run.context.step[0]
            own = jax.lax.dynamic_slice_in_dim(tokens, place, sizes.context + 1)
            return window_loss(params, extra, window, own, key)

        return jax.tree.map(jnp.mean, jax.vmap(loss)(run, keys))

    def encode_runs(params: Params, extra: PyTree, runs: Window) -> PyTree:
        """Tokens `[B, K + S, D]` of the states of B runs."""
        del extra
        return module.apply(params, jax.vmap(windows.joined)(runs), method="encode_batch")

    # To the other architecture, what a state is depends on the window that it is seen in.
    in_runs = setup.training.consecutive > 1 and setup.model.architecture == "paper"
    if in_runs and not setup.settings.repeat_state:
        raise UserError(
            f"{setup.training.consecutive} consecutive windows without repeated states: "
            "windows in a row have different later states; drop one",
            "consecutive",
            "repeat_state",
        )
    example = (run_loss, encode_runs) if in_runs else (window_loss, make_window_encoder(module))
    mean_loss = average_loss(setup, *example)
    update = make_update(mean_loss, optimizer, mesh)
    batch = run_batches(setup) if in_runs else window_batches(setup)

    def touch(module: MaskedModel, context: Context, actions: jax.Array) -> jax.Array:
        memory: PyTree = module.encode(context, returns=to_go(context))
        return module.logits(memory, actions, jnp.arange(actions.shape[0]))

    init = make_init(setup, module, touch, optimizer)
    encode_next = make_encode_next(setup, module, encode)
    return Agent(init, batch, update, energy, encode_next)


LEAP = Method(Settings, make_agent)
