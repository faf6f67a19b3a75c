"""The words of an instruction that augmentations read or exchange."""

from typing import NamedTuple

from leapjax.domains.babyai import symmetries, vocabulary
from leapjax.types import Array


class GridWords(NamedTuple):
    """Token ids of the words that augmentations read or exchange.

    Attributes:
        colours: ids `[6]` int32 of the colours, in MiniGrid's order.
        objects: ids `[3]` int32 of "key", "ball" and "box".
        mirrored: ids `[vocabulary]` int32 of the word that each word becomes in a mirror.
        then: ids `[2]` int32 of ", then".
        after: ids `[2]` int32 of "after you".
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
