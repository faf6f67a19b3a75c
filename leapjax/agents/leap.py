"""LEAP: it trains a masked language model on demonstrations, and plans by Gibbs sampling."""

import dataclasses
import functools

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
from leapjax.agents.returns import ReturnSettings
from leapjax.agents.update import make_init, make_update
from leapjax.data import windows
from leapjax.energy import pseudo_likelihood, symmetric
from leapjax.errors import UserError
from leapjax.models.masked import MaskedModel, build_masked_model
from leapjax.types import Agent, Context, Params, PyTree, Window, mask_token, pad_token


@dataclasses.dataclass(frozen=True)
class Settings(ReturnSettings):
    """The options of LEAP alone.

    Attributes:
        masking: Actions to mask in training: "one", "each", "all", "random" or "stratified". The
            function `leapjax.schedules.sample_masks` explains them.
        end: Let plans end early. Otherwise padding follows a demonstration's last action, and the
            loss skips it.
        repeat_state: Show the whole state to every position (eq. 3). Otherwise later positions see
            the state without the agent's pose.
        returns: Condition plans on the return to go, as Decision Transformer does. Only then the
            target return has an effect.
    """

    masking: str = "one"
    end: bool = True
    repeat_state: bool = True
    returns: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.masking not in schedules.MASKINGS:
            raise ValueError(
                f"unknown masking {self.masking!r}: expected one of {', '.join(schedules.MASKINGS)}"
            )

    @property
    def conditioned(self) -> bool:
        """Whether the network reads returns to go."""
        return self.returns


def make_agent(setup: Setup, mesh: Mesh | None = None) -> Agent:
    """Makes a LEAP agent.

    Args:
        setup: domain, sizes and settings.
        mesh: devices to train on (see `leapjax.sharding`); `None` for one device.
    """
    sizes, masking = setup.sizes, setup.settings.masking
    conditioned = setup.settings.returns
    module = build_masked_model(
        setup.model, sizes, setup.make_encoder(), conditioned, setup.settings.repeat_state
    )
    compute_returns = returns.condition_on_target(setup) if conditioned else returns.omit_returns
    optimizer = make_optimizer(setup.training)
    mask, pad = mask_token(sizes.num_actions), pad_token(sizes.num_actions)
    last = sizes.num_actions - 1  # the end action

    def forbid_end(logits: jax.Array) -> jax.Array:
        return logits if setup.settings.end else logits.at[:, last].set(-jnp.inf)

    def encode(params: Params, context: Context, tokens: jax.Array | None = None) -> PyTree:
        return module.apply(
            params, context, returns=compute_returns(context), tokens=tokens, method="encode"
        )

    def logits(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        result = module.apply(params, memory, actions, positions, method="logits")
        assert isinstance(result, jax.Array)
        return forbid_end(result)

    energy = pseudo_likelihood(make_encode(setup, encode), logits, sizes.num_actions)
    turn = setup.domain.turn
    if turn is not None:
        energy = symmetric(energy, functools.partial(turn, horizon=sizes.horizon))

    def window_loss(
        params: Params, extra: PyTree, window: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the masked cross-entropy of one window (paper, equation 1), and its accuracy."""
        del extra
        mask_key, encode_key, *_ = keys = jax.random.split(key, 2 + sizes.horizon)
        masks = schedules.sample_masks(mask_key, sizes.horizon, masking)  # [C, T]
        memory = module.apply(
            params, window.context, deterministic=False, method="encode",
            rngs={"dropout": encode_key}, tokens=tokens,
            returns=compute_returns(window.context, window.return_to_go),
        )  # fmt: skip

        def score(masked: jax.Array, drop_key: jax.Array) -> tuple[jax.Array, ...]:
            # The network predicts masked actions only: one masked action needs one position.
            single = masking in schedules.SINGLE
            positions = jnp.argmax(masked)[None] if single else jnp.arange(sizes.horizon)
            beyond = (window.actions == last) & (not setup.settings.end)
            masked &= window.imitated  # actions that are not imitated always stay visible
            tokens = jnp.where(masked, mask, jnp.where(beyond, pad, window.actions))
            logits = module.apply(
                params, memory, tokens, positions, deterministic=False, method="logits",
                rngs={"dropout": drop_key},
            )  # fmt: skip
            assert isinstance(logits, jax.Array)
            logits, targets = forbid_end(logits), window.actions[positions]
            likelihoods = jnp.take_along_axis(jax.nn.log_softmax(logits), targets[:, None], axis=1)
            hits = jnp.argmax(logits, axis=1) == targets
            return likelihoods[:, 0], hits, (masked & ~beyond)[positions]

        likelihoods, hits, counted = jax.vmap(score)(masks, keys[2 : 2 + masks.shape[0]])  # [C, P]
        # `where` leaves out the terms of unmasked actions, because -inf times 0 would be NaN. All
        # masked actions have equal weights.
        accuracy = jnp.where(counted, hits, 0).sum() / jnp.maximum(counted.sum(), 1)
        return -jnp.where(counted, likelihoods, 0).sum() / masks.sum(), {"accuracy": accuracy}

    def run_loss(
        params: Params, extra: PyTree, run: Window, tokens: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Averages the losses of S consecutive windows, whose states were encoded once.

        In Atari the first three states of a later window then contain frames from before that
        window. Encoding the window by itself would replace these frames with black ones.

        Args:
            params: parameters of the network.
            extra: unused.
            run: windows `[S, ...]`.
            tokens: tokens `[K + S, D]` of the windows' states.
            key: key of masks and dropout.
        """
        keys = jax.random.split(key, run.actions.shape[0])

        def loss(window: Window, key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
            place = window.context.step - run.context.step[0]
            own = jax.lax.dynamic_slice_in_dim(tokens, place, sizes.context + 1)
            return window_loss(params, extra, window, own, key)

        return jax.tree.map(jnp.mean, jax.vmap(loss)(run, keys))

    def encode_runs(params: Params, extra: PyTree, runs: Window) -> PyTree:
        """Encodes the states of B runs: tokens `[B, K + S, D]`."""
        del extra
        return module.apply(params, jax.vmap(windows.joined)(runs), method="encode_batch")

    # Tokens of architecture `leapjax` depend on the whole context, so windows cannot share them.
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
        memory: PyTree = module.encode(context, returns=compute_returns(context, jnp.zeros(())))
        return module.logits(memory, actions, jnp.arange(actions.shape[0]))

    init = make_init(setup, module, touch, optimizer)
    # A memory of `encode_next` holds no context that could be turned.
    encode_next = make_encode_next(setup, module, encode) if turn is None else None
    return Agent(init, batch, update, energy, encode_next)


LEAP = Method(Settings, make_agent)
