"""LEAP: train a masked language model on demonstrations, plan by Gibbs sampling."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from leapjax import planners, schedules
from leapjax.agents.gradients import make_update
from leapjax.data import augmentation, symmetries, windows
from leapjax.data.windows import Steps, Window
from leapjax.energy import pseudo_likelihood
from leapjax.envs import vocabulary
from leapjax.errors import check_at_least
from leapjax.models import trajectory
from leapjax.models.trajectory import ModelConfig, Sizes
from leapjax.types import Agent, Context, Energy, Params, TrainState, mask_token

UNDECAYED = ("bias", "scale", "embedding")


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """How the model is trained. The defaults are the paper's (appendix, table 5)."""

    steps: int = 1600  # 200 epochs of one window per demonstration, 500 demonstrations
    batch: int = 64
    learning_rate: float = 6e-4
    warmup: int = 100  # steps of linear warm-up, then cosine decay
    final_fraction: float = 0.1  # of the learning rate that is left at the end
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.1  # not on embeddings, norms and biases
    clip: float = 1.0  # global norm of the gradient
    masking: str = "one"  # "one", "each" or "random": see leapjax.schedules
    windows: str = "episode"  # drawn by "episode" or by "step"
    augment: bool = False  # leapjax: mirror, recolour, rename, restate at random
    exchange_objects: bool = False  # with augment: key, ball and box are alike
    clutter: float = 0.0  # leapjax: fill up to this share of the cells that nobody needs

    def __post_init__(self) -> None:
        check_at_least(self, 1, "steps", "batch")
        ranges = {
            "learning_rate": (0, 10), "weight_decay": (0, 100), "final_fraction": (0, 1),
            "warmup": (0, math.inf), "clip": (0, math.inf), "clutter": (0, 1),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:  # false for NaN too
                raise ValueError(f"{name} must be in {low} .. {high}, got {getattr(self, name)}")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"betas must be in [0, 1), got {self.betas}")
        if self.masking not in schedules.MASKINGS:
            raise ValueError(
                f"unknown masking {self.masking!r}: expected one of {', '.join(schedules.MASKINGS)}"
            )
        if self.windows not in ("episode", "step"):
            raise ValueError(f"unknown windows {self.windows!r}: expected episode or step")


def make_energy(model: ModelConfig, sizes: Sizes) -> Energy:
    """The pseudo-likelihood of the masked language model: parameters are its argument."""
    module = trajectory.build(model, sizes)

    def encode(params: Params, context: Context) -> object:
        return module.apply(params, context, method="encode")

    def logits(
        params: Params, memory: object, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        result = module.apply(params, memory, actions, positions, method="logits")
        assert isinstance(result, jax.Array)
        return result

    return pseudo_likelihood(encode, logits, sizes.num_actions)


def make_agent(
    model: ModelConfig,
    training: TrainingConfig,
    planner: planners.PlannerConfig,
    sizes: Sizes,
    words: int,
    mesh: Mesh | None = None,
) -> Agent:
    """LEAP as an `Agent`.

    Args:
        model: the network.
        training: the optimisation.
        planner: the search.
        sizes: of environment and plan.
        words: L, instruction length.
        mesh: of devices to train on (see `leapjax.sharding`); None for one device.
    """
    module = trajectory.build(model, sizes)
    optimizer = make_optimizer(training)
    energy = make_energy(model, sizes)
    mask = mask_token(sizes.num_actions)

    def init(key: jax.Array) -> TrainState:
        context = trajectory.blank_context(sizes, words)
        actions = jnp.full(sizes.horizon, mask, jnp.int32)
        params = module.init(key, context, actions, method=_encode_and_score)
        return TrainState(params, optimizer.init(params), jnp.int32(0))

    def window_loss(
        params: Params, window: Window, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Masked cross-entropy of one window (paper, equation 1), and its accuracy."""
        mask_key, encode_key, *_ = keys = jax.random.split(key, 2 + sizes.horizon)
        masks = schedules.sample_masks(mask_key, sizes.horizon, training.masking)  # [C, T]
        memory = module.apply(
            params, window.context, deterministic=False, method="encode",
            rngs={"dropout": encode_key},
        )  # fmt: skip

        def score(masked: jax.Array, drop_key: jax.Array) -> jax.Array:
            tokens = jnp.where(masked, mask, window.actions)
            positions = jnp.arange(sizes.horizon)
            logits = module.apply(
                params, memory, tokens, positions, deterministic=False, method="logits",
                rngs={"dropout": drop_key},
            )  # fmt: skip
            assert isinstance(logits, jax.Array)
            return jax.nn.log_softmax(logits)

        likelihoods = jax.vmap(score)(masks, keys[2 : 2 + masks.shape[0]])  # [C, T, A]
        chosen = jnp.take_along_axis(likelihoods, window.actions[None, :, None], axis=2)[..., 0]
        hits = jnp.argmax(likelihoods, axis=-1) == window.actions
        # Unmasked positions are not predicted: their terms are left out, not zeroed after
        # the fact, so that a -inf there cannot become NaN.
        count = masks.sum()
        accuracy = jnp.where(masks, hits, 0).sum() / count
        return -jnp.where(masks, chosen, 0).sum() / count, {"accuracy": accuracy}

    update = make_update(window_loss, optimizer, mesh)
    return Agent(init, update, energy, planners.bind(energy, planner))


def make_batch(key: jax.Array, steps: Steps, training: TrainingConfig, sizes: Sizes) -> Window:
    """The batch `[B, ...]` of a key: windows, augmented where asked for."""
    window_key, augment_key, clutter_key = jax.random.split(key, 3)
    batch = windows.sample_windows(
        window_key, steps, training.batch, sizes.context, sizes.horizon,
        sizes.num_actions - 1, training.windows,
    )  # fmt: skip
    if training.clutter:
        keys = jax.random.split(clutter_key, training.batch)
        batch = jax.vmap(lambda k, w: augmentation.clutter(k, w, training.clutter))(keys, batch)
    if training.augment:
        words = augmentation.GridWords(
            jnp.asarray(vocabulary.colour_words()),
            jnp.asarray(vocabulary.object_words(symmetries.INTERCHANGEABLE)),
            jnp.asarray(vocabulary.mirrored_words()),
            *map(jnp.asarray, vocabulary.joining_words()),
        )
        keys = jax.random.split(augment_key, training.batch)
        batch = jax.vmap(lambda k, w: augmentation.augment(k, w, words, training.exchange_objects))(
            keys, batch
        )
    return batch


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


def _encode_and_score(
    module: trajectory.PaperModel | trajectory.LeapModel, context: Context, actions: jax.Array
) -> jax.Array:
    """Touches every parameter of a model, to initialise them."""
    return module.logits(module.encode(context), actions, jnp.arange(actions.shape[0]))
