"""What agents share: the setup they are made from, optimisation, one gradient step."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from leapjax import sharding
from leapjax.checks import check_at_least, check_types, check_within
from leapjax.data import windows
from leapjax.data.windows import Steps
from leapjax.domain import Domain, blank_context, check_context
from leapjax.energy import single_action
from leapjax.errors import UserError
from leapjax.models.encoder import Encoder
from leapjax.models.policy import PolicyModel
from leapjax.models.trajectory import ModelConfig, Sizes
from leapjax.planners import GibbsConfig
from leapjax.types import (
    Agent,
    Context,
    Demonstration,
    EncodeNext,
    Energy,
    Params,
    PyTree,
    TrainState,
    Window,
)

UNDECAYED = ("bias", "scale", "embedding")
# Settings of training that change how a step is computed, and not what comes of it: no name of a
# run or a checkpoint is made from them.
UNNAMED = ("microbatch",)


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """How a network is trained. The defaults are the paper's (appendix, table 5).

    1600 steps are 200 epochs of one window for each of 500 demonstrations.

    Attributes:
        steps: Training steps.
        batch: Training windows in a step.
        learning_rate: Learning rate of AdamW after the warm-up.
        warmup: Steps of linear warm-up, at most a tenth of all; cosine decay follows.
        final_fraction: Share of the learning rate that is left at the end.
        betas: Decay rates of AdamW's two moments.
        weight_decay: Weight decay of all parameters but embeddings, norms and biases.
        clip: Largest global norm of the gradient; inf for no clipping.
        windows: How training windows are drawn: by "episode", each equally often, by "step", each
            equally often, or at the "start" of episodes.
        microbatch: Windows whose loss a device computes at a time; 0 for all of its share.
        consecutive: Consecutive windows in one training example, in which each state is encoded
            once; 1 draws windows alone.
    """

    steps: int = 1600
    batch: int = 64
    learning_rate: float = 6e-4
    warmup: int = 100
    final_fraction: float = 0.1
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.1
    clip: float = 1.0
    windows: str = "episode"
    microbatch: int = 0
    consecutive: int = 1

    def __post_init__(self) -> None:
        check_types(self, "clip")
        check_at_least(self, 0, "steps", "microbatch", "warmup")
        check_at_least(self, 1, "batch", "consecutive")
        check_within(self, 0, 10, "learning_rate")
        check_within(self, 0, 100, "weight_decay")
        check_within(self, 0, 1, "final_fraction")
        if self.clip <= 0:
            raise ValueError(f"clip must be positive, got {self.clip}: nothing would be learned")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"betas must be in [0, 1), got {self.betas}")
        if self.batch % self.consecutive:
            raise ValueError(
                f"a batch of {self.batch} windows is not a multiple of {self.consecutive} "
                "consecutive windows"
            )
        if self.windows not in windows.SAMPLINGS:
            known = ", ".join(windows.SAMPLINGS)
            raise ValueError(f"unknown windows {self.windows!r}: expected one of {known}")


class Setup(NamedTuple):
    """What every method is made from.

    Attributes:
        domain: the level to learn.
        context: K, past steps that the network sees.
        horizon: T, planned actions.
        model: the size of the network.
        training: how it is trained.
        settings: of the method, an instance of `Method.settings`.
    """

    domain: Domain
    context: int
    horizon: int
    model: ModelConfig
    training: TrainingConfig
    settings: Any

    @property
    def sizes(self) -> Sizes:
        """What the model must know."""
        domain = self.domain
        return Sizes(domain.num_actions, self.context, self.horizon, domain.max_steps)

    def encoder(self) -> Encoder:
        """The domain's encoder for the model's architecture.

        Raises:
            UserError: the domain has none.
        """
        name = self.model.architecture
        if name not in self.domain.encoders:
            raise UserError(
                f"{self.domain.level} has no encoder for architecture {name!r}: "
                f"expected one of {', '.join(self.domain.encoders)}"
            )
        return self.domain.encoders[name](self.model, self.context)

    def policy(self, *heads: tuple[str, int], conditioned: bool = False) -> PolicyModel:
        """The network of a method that chooses one action at a time.

        Args:
            heads: what it says: a name, and how many numbers.
            conditioned: on returns to go.

        Raises:
            UserError: plans are not of one action.
        """
        self.check_single_action()
        return PolicyModel(self.model, self.sizes, self.encoder(), heads, conditioned)

    def check_single_action(self) -> None:
        """Refuses plans of several actions.

        Raises:
            UserError: plans are not of one action.
        """
        if self.horizon != 1:
            raise UserError(
                f"a horizon of {self.horizon}: this method chooses one action at a time, so its "
                "horizon is 1",
                "horizon",
            )


class Method(NamedTuple):
    """A way to learn and to act, as the table of methods has it.

    Attributes:
        settings: a frozen dataclass: the options that only this method has.
        make_agent: (setup, mesh of devices to train on) -> agent; mesh None: one device.
        rewards: whether it learns from rewards: data without any are refused.
        planner: a frozen dataclass: the settings of how it searches.
        everywhere: whether every domain can have it, so that it is one of `--method all`.
    """

    settings: type
    make_agent: Callable[[Setup, Mesh | None], Agent]
    rewards: bool = False
    planner: type = GibbsConfig
    everywhere: bool = True


def untrained(energy: Energy) -> Agent:
    """An agent whose energy has nothing to learn: its parameters are `()`."""

    def init(key: jax.Array) -> TrainState:
        del key
        return TrainState((), (), jnp.int32(0))

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        del batch, key
        return state._replace(step=state.step + 1), {"loss": jnp.zeros(())}

    return Agent(init, lambda key, steps: (), update, energy)


BatchLoss = Callable[
    [Params, PyTree, PyTree, jax.Array], tuple[jax.Array, dict[str, jax.Array]]
]  # (params, extra, batch [B, ...], keys [B]) -> loss [] and metrics, means over the batch
EncodeExamples = Callable[[Params, PyTree, PyTree], PyTree]
# (params, extra, batch [B, ...]) -> tokens [B, ...] of the contexts of the examples
ExampleLoss = Callable[
    [Params, PyTree, PyTree, PyTree, jax.Array], tuple[jax.Array, dict[str, jax.Array]]
]  # (params, extra, example, its tokens, key) -> loss [] and metrics
Update = Callable[[TrainState, PyTree, jax.Array], tuple[TrainState, dict[str, jax.Array]]]


def average_loss(setup: Setup, example_loss: ExampleLoss, encode: EncodeExamples) -> BatchLoss:
    """The mean of a loss of one example, over a batch whose contexts are encoded together.

    The encoder has all contexts of a device at once, however few examples the loss takes at a time
    (`TrainingConfig.microbatch`): products of few rows are slow (docs/performance.md).

    Args:
        setup: what the agent is made from.
        example_loss: of an example and its tokens.
        encode: the contexts of a batch.
    """

    def examples_loss(
        params: Params, tokens: PyTree, extra: PyTree, rows: tuple[PyTree, jax.Array]
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        each = jax.vmap(example_loss, in_axes=(None, None, 0, 0, 0))
        examples, keys = rows
        return jax.tree.map(jnp.mean, each(params, extra, examples, tokens, keys))

    in_parts = _take_in_parts(examples_loss, setup.training.microbatch)

    def batch_loss(
        params: Params, extra: PyTree, batch: PyTree, keys: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        return in_parts(params, encode(params, extra, batch), extra, (batch, keys))

    return batch_loss


def _take_in_parts(loss: Callable[..., Any], most: int) -> Callable[..., Any]:
    """A loss that is a mean over examples, taken for a few examples at a time.

    Each part's gradient is computed with its value, so that nothing else of it is stored.

    Args:
        loss: (params, tokens, extra, rows) -> loss [] and metrics. Tokens and rows are of examples,
            `[B, ...]`; gradients are by parameters and tokens.
        most: examples in a part; 0 for all.
    """
    differentiate = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)

    @jax.custom_vjp
    def mean(*inputs: PyTree) -> PyTree:
        return forward(*inputs)[0]

    def forward(
        params: Params, tokens: PyTree, extra: PyTree, rows: PyTree
    ) -> tuple[PyTree, tuple[Params, PyTree]]:
        size = jax.tree.leaves(rows)[0].shape[0]
        count = next(count for count in range(-(-size // most), size + 1) if size % count == 0)
        parts = jax.tree.map(
            lambda x: x.reshape(count, size // count, *x.shape[1:]), (tokens, rows)
        )

        def add(totals: PyTree, part: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
            means, (gradient, by_tokens) = differentiate(params, part[0], extra, part[1])
            return jax.tree.map(jnp.add, totals, (means, gradient)), by_tokens

        one = jax.tree.map(lambda x: x[0], parts)
        means, (gradient, _) = jax.eval_shape(differentiate, params, one[0], extra, one[1])
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (means, gradient))
        found = jax.lax.scan(add, zeros, parts)
        (means, gradient), by_tokens = jax.tree.map(lambda x: x / count, found)
        return means, (gradient, jax.tree.map(lambda x, y: x.reshape(y.shape), by_tokens, tokens))

    def backward(gradients: PyTree, cotangents: PyTree) -> tuple[PyTree, ...]:
        return *jax.tree.map(lambda x: cotangents[0] * x, gradients), None, None

    mean.defvjp(forward, backward)
    return mean if most else loss


def encode_windows(module: nn.Module) -> EncodeExamples:
    """Encodes the contexts of windows with a network, for `average_loss`."""

    def encode(params: Params, extra: PyTree, batch: Window) -> PyTree:
        del extra
        return module.apply(params, batch.context, method="encode_batch")

    return encode


def make_update(
    batch_loss: BatchLoss,
    optimizer: optax.GradientTransformation,
    mesh: Mesh | None = None,
    next_extra: Callable[[PyTree, Params], PyTree] = lambda extra, params: extra,
) -> Update:
    """An agent's `update`.

    Args:
        batch_loss: means over the examples of a device.
        optimizer: turns gradients into updates.
        mesh: splits every batch, and the state as `sharding.parameter_specs` says; None for
            one device.
        next_extra: (extra, new parameters) -> the state's `extra` after the step.
    """

    def differentiate(
        params: Params, extra: PyTree, batch: PyTree, key: jax.Array, first: jax.Array | int
    ) -> PyTree:
        """((loss, metrics), gradients) of the examples of a device."""
        # Keys by place in the whole batch: however it is split, an example meets its own.
        places = first + jnp.arange(jax.tree.leaves(batch)[0].shape[0])
        keys = jax.vmap(lambda place: jax.random.fold_in(key, place))(places)
        return jax.value_and_grad(batch_loss, has_aux=True)(params, extra, batch, keys)

    def mean_gradient(params: Params, extra: PyTree, batch: PyTree, key: jax.Array) -> PyTree:
        """((loss, metrics), gradients) of a batch."""
        if mesh is None:
            return differentiate(params, extra, batch, key, 0)
        specs = sharding.parameter_specs(params, mesh)
        extra_specs = sharding.parameter_specs(extra, mesh)

        def on_each_device(parts: Params, extra: PyTree, rows: PyTree, key: jax.Array) -> PyTree:
            first = jax.lax.axis_index(sharding.AXES) * jax.tree.leaves(rows)[0].shape[0]
            whole = sharding.gather(parts, specs), sharding.gather(extra, extra_specs)
            means, gradients = differentiate(*whole, rows, key, first)
            return jax.lax.pmean(means, sharding.AXES), sharding.scatter_mean(gradients, specs)

        return jax.shard_map(
            on_each_device, mesh=mesh, check_vma=False,
            in_specs=(specs, extra_specs, sharding.SPLIT, sharding.REPLICATED),
            out_specs=(sharding.REPLICATED, specs),
        )(params, extra, batch, key)  # fmt: skip

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        (loss, metrics), gradients = mean_gradient(state.params, state.extra, batch, key)
        updates, opt_state = optimizer.update(gradients, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        norm = optax.tree.norm(gradients)
        extra = next_extra(state.extra, params)
        state = TrainState(params, opt_state, state.step + 1, extra)
        if mesh is not None:  # where it was: the next step is then the same program
            places = sharding.parameter_shardings(state, mesh)
            state = jax.lax.with_sharding_constraint(state, places)
        return state, {"loss": loss, **metrics, "gradient_norm": norm}

    return update


def say_all(module: nn.Module, context: Context, actions: jax.Array) -> PyTree:
    """Touches every parameter of a network that is asked about a context alone: see `make_init`."""
    del actions
    return module(context)


def make_init(
    setup: Setup,
    module: nn.Module,
    touch: Callable[..., PyTree],
    optimizer: optax.GradientTransformation,
    target: Callable[[Params], PyTree] = lambda params: (),
) -> Callable[[jax.Array], TrainState]:
    """An agent's `init`: the parameters that a network has before it has seen anything.

    Args:
        setup: what the agent is made from.
        module: the network.
        touch: (module, context, actions `[T]`) -> anything that uses every parameter.
        optimizer: that will train them.
        target: which of them a target network begins with.
    """

    def init(key: jax.Array) -> TrainState:
        context = jax.tree.map(jnp.asarray, blank_context(setup.domain, setup.context))
        actions = jnp.zeros(setup.horizon, jnp.int32)
        params = module.init(key, context, actions, method=touch)
        # A copy: a state that is updated in place must hold each array once.
        extra = jax.tree.map(jnp.copy, target(params))
        return TrainState(params, optimizer.init(params), jnp.int32(0), extra)

    return init


def follow(
    rate: float, part: Callable[[Params], PyTree] = lambda params: params
) -> Callable[[PyTree, Params], PyTree]:
    """A target network's step towards a part of the parameters (Lillicrap et al., 2016).

    Args:
        rate: in 0 .. 1, how far.
        part: of all parameters, those that it has.
    """

    def step(target: PyTree, params: Params) -> PyTree:
        return optax.incremental_update(part(params), target, rate)

    return step


def check_shares(settings: object, *names: str) -> None:
    """Checks settings that are shares.

    Raises:
        ValueError: names the first that is not in 0 .. 1.
    """
    check_within(settings, 0, 1, *names)


def blank_steps(domain: Domain) -> Steps:
    """One step of a domain in which there is nothing: the structure of all its `Steps`."""
    states = jax.tree.map(lambda x: np.stack([x, x]), domain.blank)
    actions, rewards = np.zeros(1, np.int32), np.zeros(1, np.float32)
    blank = Demonstration(states, actions, rewards, True, False, 0)
    return windows.concatenate([blank], domain.augmentations.extras)


def context_encoder(
    encode: Callable[[Params, Context], PyTree], setup: Setup
) -> Callable[[Params, Context], PyTree]:
    """An energy's `encode`, which refuses contexts of other shapes while it is traced."""

    def checked(params: Params, context: Context) -> PyTree:
        check_context(context, setup.domain, setup.context)
        return encode(params, jax.tree.map(jnp.asarray, context))

    return checked


def make_encode_next(
    setup: Setup, module: nn.Module, encode: Callable[[Params, Context, jax.Array], PyTree]
) -> EncodeNext | None:
    """An agent's `encode_next`, whose cache are the tokens `[K, D]` of the last K states.

    None where there is not a token for each state of a context, or no past.

    Args:
        setup: what the agent is made from.
        module: the network, with `encode_next` of its encoder.
        encode: (params, context, tokens of the encoder) -> memory.
    """
    if setup.model.architecture != "paper" or setup.context == 0:
        return None

    def encode_next(params: Params, context: Context, cache: PyTree) -> tuple[PyTree, PyTree]:
        check_context(context, setup.domain, setup.context)
        context = jax.tree.map(jnp.asarray, context)
        tokens: Any = module.apply(params, context, cache, method="encode_next")
        return encode(params, context, tokens), tokens[1 : setup.context + 1]

    return encode_next


def acting_energy(
    setup: Setup,
    say: Callable[[Params, Context], PyTree],
    scores: Callable[[PyTree], jax.Array] = lambda said: said["logits"],
) -> Energy:
    """The energy of a method that chooses one action at a time.

    Args:
        setup: what the method is made from.
        say: (params, context) -> what its network says.
        scores: of what it says, `[P, A - 1]` logits or Q-values, at the current state last.
    """
    return single_action(
        context_encoder(say, setup),
        lambda params, said: scores(said)[-1],
        setup.domain.num_actions,
    )


def make_optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    """AdamW with clipping, linear warm-up and cosine decay (paper, appendix, table 5)."""
    warmup = min(config.warmup, config.steps // 10)
    rate = optax.warmup_cosine_decay_schedule(
        config.learning_rate / max(warmup, 1) if warmup else config.learning_rate,
        config.learning_rate,
        warmup,
        max(config.steps, warmup + 1),
        config.learning_rate * config.final_fraction,
    )
    return optax.chain(
        optax.clip_by_global_norm(config.clip),
        optax.adamw(rate, *config.betas, weight_decay=config.weight_decay, mask=decayed_parameters),
    )


def decayed_parameters(params: Params) -> Params:
    """True where weight decay applies: not on embeddings, norms and biases."""
    return jax.tree_util.tree_map_with_path(lambda path, _: path[-1].key not in UNDECAYED, params)
