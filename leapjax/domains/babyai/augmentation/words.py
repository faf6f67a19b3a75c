"""The words of an instruction that augmentations read or exchange."""

from typing import NamedTuple

from leapjax.domains.babyai import symmetries, vocabulary
from leapjax.types import Array


class GridWords(NamedTuple):
    """Token ids of the words that augmentations read or exchange.

    Attributes:
        colours: `[6]` int32, in MiniGrid's order of colours.
        objects: `[3]` int32: key, ball, box.
        mirrored: `[vocabulary]` int32: the word that each word becomes in a mirror.
        then: `[2]` int32: ", then".
        after: `[2]` int32: "after you".
    """

    colours: Array
    objects: Array
    mirrored: Array
    then: Array
    after: Array


def find_words() -> GridWords:
    """Finds these words in BabyAI's vocabulary."""
    return GridWords(
        vocabulary.colour_words(),
        vocabulary.object_words(symmetries.INTERCHANGEABLE),
        vocabulary.mirrored_words(),
        *vocabulary.joining_words(),
    )
