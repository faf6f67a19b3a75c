"""Encodes instructions as token ids, which follow BabyAI's grammar and do not depend on the data.

Every registered BabyAI level uses this language (minigrid.envs.babyai.core.verifier):

    instruction = sequence | pair;  sequence = pair ", then" pair | pair "after you" pair
    pair        = clause | clause "and" clause
    clause      = "go to" d | "pick up" d | "open" d | "put" d "next to" d
    d           = ("the" | "a") [colour] type [place]
    place       = "in front of you" | "behind you" | "on your left" | "on your right"
"""

import re

import numpy as np
from minigrid.core.constants import IDX_TO_COLOR, IDX_TO_OBJECT

from leapjax.errors import UserError

WORDS = (
    *("go", "to", "pick", "up", "open", "put", "next", "then", "after", "you", "and", ","),
    *("the", "a", "object", "box", "ball", "key", "door"),
    *("red", "green", "blue", "purple", "yellow", "grey"),
    *("in", "front", "of", "behind", "on", "your", "left", "right"),
)
PAD = 0  # fills an instruction on the right
WORD_IDS = {word: index for index, word in enumerate(WORDS, start=1)}
SIZE = len(WORD_IDS) + 1  # padding included

# "put the red ball in front of you next to the red ball in front of you"
LONGEST_CLAUSE = 17
LONGEST = 4 * LONGEST_CLAUSE + 4  # four clauses, "and" twice, and ", then" or "after you"


def encode(instruction: str, length: int) -> np.ndarray:
    """Encodes an instruction as token ids `[length]` int32, padded on the right.

    Raises:
        UserError: a word is not BabyAI's (names it), or there are too many words.
    """
    words = re.findall(r"[a-z]+|[^a-z\s]", instruction.lower())
    unknown = [word for word in words if word not in WORD_IDS]
    if unknown:
        raise UserError(
            f"unknown word {unknown[0]!r} in instruction {instruction!r}: "
            f"BabyAI's words are {', '.join(WORDS)}"
        )
    if len(words) > length:
        raise UserError(
            f"instruction of {len(words)} words where at most {length} fit: {instruction!r}"
        )
    ids = np.zeros(length, np.int32)
    ids[: len(words)] = [WORD_IDS[word] for word in words]
    return ids


def decode(ids: np.ndarray) -> str:
    """Decodes token ids to an instruction."""
    words = [WORDS[index - 1] for index in np.asarray(ids) if index != PAD]
    return " ".join(words).replace(" ,", ",")


def mirrored_words() -> np.ndarray:
    """Returns ids `[SIZE]` int32 of each word in a mirrored world (left and right swapped)."""
    ids = np.arange(SIZE, dtype=np.int32)
    left, right = WORD_IDS["left"], WORD_IDS["right"]
    ids[[left, right]] = right, left
    return ids


def colour_words() -> np.ndarray:
    """Returns ids `[6]` int32 of the words for colours, in MiniGrid's order of colours."""
    return np.array([WORD_IDS[IDX_TO_COLOR[i]] for i in sorted(IDX_TO_COLOR)], np.int32)


def object_words(objects: tuple[int, ...]) -> np.ndarray:
    """Returns ids, int32, of the words for MiniGrid's object indices."""
    return np.array([WORD_IDS[IDX_TO_OBJECT[i]] for i in objects], np.int32)


def joining_words() -> tuple[np.ndarray, np.ndarray]:
    """Returns the ids of ", then" and of "after you", `[2]` int32 each."""
    then, after = [WORD_IDS[","], WORD_IDS["then"]], [WORD_IDS["after"], WORD_IDS["you"]]
    return np.array(then, np.int32), np.array(after, np.int32)
