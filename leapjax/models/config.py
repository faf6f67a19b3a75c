"""The configuration of networks: `ModelConfig`, and the `Sizes` of contexts and plans."""

import dataclasses

from leapjax.checks import check_at_least, check_types

ARCHITECTURES = ("paper", "leapjax")
ATTENTIONS = ("full", "causal")
DTYPES = ("float32", "bfloat16")
MOST_LAYERS = 200  # XLA takes about a second to compile a layer


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The network. The defaults are the paper's transformer.

    Attributes:
        architecture: "leapjax" for our network, "paper" for the network of the appendix.
        layers: Transformer layers.
        heads: Attention heads.
        width: D, embedding dimension; a multiple of the heads.
        dropout: Dropout rate of embeddings, attention and residuals.
        dtype: Type of matrix products, "float32" or "bfloat16"; parameters are always float32.
        attention: Attention between the actions of a plan: "full", or "causal", which hides later
            actions.
    """

    architecture: str = "leapjax"
    layers: int = 3
    heads: int = 4
    width: int = 128
    dropout: float = 0.1
    dtype: str = "float32"
    attention: str = "full"

    def __post_init__(self) -> None:
        check_types(self)
        if self.architecture not in ARCHITECTURES:
            raise ValueError(
                f"unknown architecture {self.architecture!r}: "
                f"expected one of {', '.join(ARCHITECTURES)}"
            )
        if self.attention not in ATTENTIONS:
            raise ValueError(
                f"unknown attention {self.attention!r}: expected one of {', '.join(ATTENTIONS)}"
            )
        check_at_least(self, 1, "layers", most=MOST_LAYERS)
        check_at_least(self, 1, "heads", "width")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {self.dropout}")
        if self.dtype not in DTYPES:
            raise ValueError(f"unknown dtype {self.dtype!r}: expected one of {', '.join(DTYPES)}")
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of {self.heads} heads")


@dataclasses.dataclass(frozen=True)
class Sizes:
    """The sizes of contexts, plans and episodes that a network is made for.

    Attributes:
        num_actions: A, number of actions with the end action.
        context: K, number of past steps.
        horizon: T, number of planned actions.
        max_steps: length of the longest episode, for the embedding of time.
    """

    num_actions: int
    context: int
    horizon: int
    max_steps: int
