"""The optimizer of every method: AdamW, as in the paper's appendix (table 6)."""

import jax
import optax

from leapjax.agents.base import TrainingConfig
from leapjax.types import Params

UNDECAYED = ("bias", "scale", "embedding")  # parameters without weight decay, by name


def make_optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    """Makes AdamW with clipping, linear warm-up and cosine decay (paper, appendix, table 6)."""
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
        optax.adamw(
            rate, *config.betas, weight_decay=config.weight_decay, mask=mask_decayed_parameters
        ),
    )


def mask_decayed_parameters(params: Params) -> Params:
    """Returns True for parameters with weight decay: all but embeddings, norms and biases."""
    return jax.tree_util.tree_map_with_path(lambda path, _: path[-1].key not in UNDECAYED, params)
