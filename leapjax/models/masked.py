"""Masked language models over plans (paper, section 3.1): one network for each architecture.

Both networks score actions from the same `Context`, by `encode` and then `logits`. Every position
of a plan sees the current state and no later one (paper, equation 3). So `encode` runs once per
plan, and only the action tokens change from pass to pass. The domain's `Encoder`, a field of the
network, turns states into tokens.
"""

from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.paper import PaperModel
from leapjax.models.prefix import PrefixModel

MaskedModel = PaperModel | PrefixModel


def build_masked_model(
    config: ModelConfig,
    sizes: Sizes,
    encoder: Encoder,
    conditioned: bool = False,
    repeat_state: bool = True,
) -> MaskedModel:
    """Builds the network of a configuration around a domain's encoder.

    Args:
        config: architecture and size of the network.
        sizes: sizes of contexts and plans.
        encoder: encoder of the domain for this architecture.
        conditioned: whether the network is conditioned on returns to go.
        repeat_state: whether all positions of a plan hold the current state (paper, equation 3);
            if not, later positions hold a state without a pose.

    Raises:
        UserError: `repeat_state` is False, and the encoder has no token for later states.
    """
    encoder = encoder if repeat_state else encoder.add_later_state()
    if config.architecture == "paper":
        return PaperModel(config, sizes, encoder, conditioned)
    return PrefixModel(config, sizes, encoder.for_plans(sizes.horizon), conditioned)
