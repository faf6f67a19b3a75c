"""The options of the BabyAI domain."""

import dataclasses

from leapjax.checks import check_at_least, check_types, check_within


@dataclasses.dataclass(frozen=True)
class Settings:
    """BabyAI: augmentation of demonstrations, and the encoders.

    Attributes:
        augment: Change training windows at random: mirror the level, recolour and rename objects,
            and restate the instruction.
        exchange_objects: With `augment`: also exchange keys, balls and boxes for each other.
        clutter: Largest probability, in 0 .. 1, that a free cell gets a random object. Cells that
            the demonstration needs stay free.
        hidden_goals: Probability, in 0 .. 1, that a training window does not show its goal, so that
            the network learns to find it from the instruction.
        channels: Features of each grid cell.
        rounds: Rounds of convolution over the grid.
        fields: Learned distance fields; 0 for convolutions alone.
        sweeps: Rounds of value iteration that compute the distance fields.
        word_heads: Attention heads from cells to the words of the instruction; 0 for no attention.
        memory: Mark where the agent picked up, dropped and toggled, which cells its first pose saw
            ahead and on its right, and what has the colour of a locked door. Only things attend to
            words, and words to things: so words find out which of their tasks are done. For long
            instructions; needs `word_heads`.
        radius: Cells around the agent, in each direction, that are read one by one.
    """

    augment: bool = False
    exchange_objects: bool = False
    clutter: float = 0.0
    hidden_goals: float = 0.0
    channels: int = 32
    rounds: int = 2
    fields: int = 8
    sweeps: int = 16
    word_heads: int = 0
    memory: bool = False
    radius: int = 3

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "channels", most=10_000)
        check_at_least(self, 1, "sweeps", most=10_000)  # no path in any level is longer
        check_at_least(self, 0, "rounds", most=200)  # each round is compiled by itself
        check_at_least(self, 0, "fields", "word_heads", most=1000)
        check_at_least(self, 0, "radius", most=100)  # no level is larger
        check_within(self, 0, 1, "clutter", "hidden_goals")
        if self.memory and not self.word_heads:
            raise ValueError("memory needs word_heads: cells learn from words what is done")
