"""The options of this domain."""

import dataclasses

from leapjax.checks import check_at_least, check_types, check_within


@dataclasses.dataclass(frozen=True)
class Settings:
    """BabyAI: augmentation of demonstrations, and the encoders."""

    augment: bool = False  # mirror, recolour, rename, restate at random
    exchange_objects: bool = False  # with augment: key, ball and box are alike
    clutter: float = 0.0  # fill up to this share of the cells that nobody needs
    lookalikes: bool = False  # clutter may be like the target in kind or in colour
    false_starts: float = 0.0  # share of windows that begin with random moves (no past states)
    detours: float = 0.0  # share of windows that are to lead around things (no past states)
    channels: int = 32  # features per grid cell
    rounds: int = 2  # rounds of convolution over the grid
    fields: int = 8  # learned distance fields; 0: convolutions alone
    sweeps: int = 16  # rounds of value iteration that make them
    word_heads: int = 0  # attention heads from cells to words; 0: none
    radius: int = 3  # how far around the agent its cells are read one by one

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "channels", most=10_000)
        check_at_least(self, 1, "sweeps", most=10_000)  # no way in any level is longer
        check_at_least(self, 0, "rounds", most=200)  # each is compiled by itself
        check_at_least(self, 0, "fields", "word_heads", most=1000)
        check_at_least(self, 0, "radius", most=100)  # no level is larger
        check_within(self, 0, 1, "clutter", "false_starts", "detours")
