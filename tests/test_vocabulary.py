import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from leapjax.domains.babyai import levels, vocabulary
from leapjax.errors import UserError

words = st.sampled_from(vocabulary.WORDS)


def missions(name: str, seeds: range) -> list[str]:
    env = levels.make_environment(levels.find_level(name))
    env.gen_obs = lambda: {}  # nobody looks, and drawing the view is the slowest part
    texts = []
    for seed in seeds:
        with levels.silenced():
            env.reset(seed=seed)
        texts.append(env.mission)
    return texts


def test_every_registered_level_speaks_the_vocabulary():
    names = levels.registered_levels()
    assert len(names) >= 90
    spoken = set()
    for name in names:
        for mission in missions(name, range(2)):
            ids = vocabulary.encode(mission, vocabulary.LONGEST)
            assert ids.shape == (vocabulary.LONGEST,) and ids.dtype == np.int32
            assert vocabulary.decode(ids) == mission, name
            spoken |= set(ids.tolist())
    # The other way round: nearly every word is one that some level uses.
    assert len(spoken) > 0.8 * vocabulary.SIZE


@given(st.lists(words, min_size=1, max_size=30), st.integers(0, 5))
def test_encoding_is_one_id_per_word_then_padding(sentence, room):
    ids = vocabulary.encode(" ".join(sentence), len(sentence) + room)
    assert [vocabulary.WORDS[i - 1] for i in ids[: len(sentence)]] == sentence
    assert (ids[: len(sentence)] != vocabulary.PAD).all()
    assert (ids[len(sentence) :] == vocabulary.PAD).all()
    np.testing.assert_array_equal(ids, vocabulary.encode(vocabulary.decode(ids), len(ids)))


@pytest.mark.parametrize(
    ("instruction", "unknown"),
    [("go to the pink ball", "pink"), ("go to the red ball!", "!"), ("go 2 the ball", "2")],
)
def test_an_unknown_word_is_named(instruction, unknown):
    with pytest.raises(UserError, match=f"unknown word '{unknown}'"):
        vocabulary.encode(instruction, 20)


def test_the_longest_instruction_of_the_grammar_fits():
    place = "the purple object in front of you"
    clause = f"put {place} next to {place}"
    longest = f"{clause} and {clause}, then {clause} and {clause}"
    ids = vocabulary.encode(longest, vocabulary.LONGEST)
    assert (ids != vocabulary.PAD).all()
    assert vocabulary.decode(ids) == longest


@given(st.lists(words, min_size=1, max_size=30))
def test_a_mirror_exchanges_left_and_right_only(sentence):
    mirrored = vocabulary.mirrored_words()
    ids = vocabulary.encode(" ".join(sentence), len(sentence) + 1)
    np.testing.assert_array_equal(mirrored[mirrored[ids]], ids)
    swap = {"left": "right", "right": "left"}
    expected = vocabulary.encode(" ".join(swap.get(w, w) for w in sentence), len(ids))
    np.testing.assert_array_equal(mirrored[ids], expected)


def test_names_of_colours_and_objects_follow_minigrid():
    colours = ["red", "green", "blue", "purple", "yellow", "grey"]
    assert vocabulary.decode(vocabulary.colour_words()) == " ".join(colours)
    assert vocabulary.decode(vocabulary.object_words((5, 6, 7))) == "key ball box"
