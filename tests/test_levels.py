"""The levels of BabyAI and the words of their instructions."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from leapjax.domains.babyai import levels, vocabulary
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.errors import UserError

# From the paper's appendix: side, rooms, objects, doors (table "BabyAI environment setting"), then
# K, T and N (table "BabyAI environment experiment details"). Last, MiniGrid's step limit; a
# sequence has 100 steps for each goal.
PAPER = {
    "GoToLocalS7N5": (7, 1, 5, "none", 0, 5, 10, 49),
    "GoToLocalS8N7": (8, 1, 7, "none", 0, 5, 10, 64),
    "GoToObjMazeS4": (10, 9, 1, "open", 0, 10, 30, 144),
    "GoToObjMazeS7": (19, 9, 1, "open", 0, 15, 50, 441),
    "GoToObjMazeS4R2Close": (7, 4, 1, "closed", 0, 5, 10, 64),
    "PickUpLoc": (8, 1, 8, "none", 0, 5, 10, 64),
    "GoToSeqS5R2": (9, 4, 4, "closed", 20, 5, 10, None),
}
sentences = st.lists(st.sampled_from(vocabulary.WORDS), min_size=1, max_size=30)


def list_cells(env, *kinds: str) -> list:
    return [cell for cell in env.grid.grid if cell is not None and cell.type in kinds]


@pytest.mark.parametrize("name", PAPER)
def test_levels_match_the_tables_of_the_paper(name):
    assert set(levels.LEVELS) == set(PAPER)
    side, rooms, objects, doors, context, horizon, iterations, limit = PAPER[name]
    level = levels.find_level(name)
    assert (level.context, level.horizon, level.iterations) == (context, horizon, iterations)
    env = levels.make_environment(level)
    lengths, limits = set(), set()
    for seed in range(50):
        with levels.silenced():
            env.reset(seed=seed)
        assert env.max_steps == (limit or 100 * env.mission.count("go to"))
        limits.add(env.max_steps)
        lengths.add(len(re.findall(r"\w+|,", env.mission)))
        assert env.grid.encode().shape == (side, side, 3)
        assert env.num_rows * env.num_cols == rooms
        assert len(list_cells(env, "key", "ball", "box")) == objects
        found = list_cells(env, "door")
        assert (doors == "none") == (not found)
        if found:
            assert len(found) >= rooms - 1  # every room can be reached
            assert {door.is_open for door in found} == {doors == "open"}
            assert not any(door.is_locked for door in found)
    assert max(lengths) == level.words
    assert (len(limits) > 1) == (limit is None)


def test_unknown_level_error_suggests_a_similar_name_or_lists_all():
    with pytest.raises(UserError, match="'gotolocals7n5'.*did you mean GoToLocalS7N5"):
        levels.find_level("gotolocals7n5")
    with pytest.raises(UserError, match="registered BabyAI level$") as raised:
        levels.find_level("?!")
    assert all(name in str(raised.value) for name in PAPER)


def test_every_registered_level_can_be_observed_and_encoded():
    names = levels.registered_levels()
    used, oblong = set(), {}
    for name in names:
        adapter = BabyAIAdapter(levels.find_level(name))
        observation = adapter.reset(3)
        width, height = adapter.env.width, adapter.env.height
        side = max(width, height)
        assert observation.grid.shape == (side, side, 3), name
        # Padding of a level that is not square is 0, "unseen"; cells inside are never 0.
        assert (observation.grid[:width, :height, 0] > 0).all(), name
        assert not observation.grid[width:].any() and not observation.grid[:, height:].any(), name
        if width != height:
            oblong[name] = width, height
        mission = adapter.env.mission
        ids = vocabulary.encode(mission, vocabulary.LONGEST)
        assert ids.shape == (vocabulary.LONGEST,) and ids.dtype == np.int32
        assert vocabulary.decode(ids) == mission, name
        used |= set(ids.tolist())
    assert len(names) >= 90 and len(oblong) == 18 and oblong["BabyAI-OpenRedDoor-v0"] == (9, 5)
    # Conversely, levels use most words of the vocabulary.
    assert len(used) > 0.75 * vocabulary.SIZE


def test_level_generation_prints_nothing(capsys):
    level = levels.find_level("GoToSeqS5R2")
    env, noisy = levels.make_environment(level), []
    for seed in range(10):
        with levels.silenced() as output:
            env.reset(seed=seed)
        noisy += [seed] if output.getvalue() else []
    assert noisy  # without `silenced`, some levels print
    adapter = BabyAIAdapter(level)
    for seed in noisy:
        adapter.reset(seed)
    assert capsys.readouterr() == ("", "")


@given(sentences, st.integers(1, 5))
def test_instructions_are_padded_and_mirroring_swaps_left_and_right(sentence, padding):
    ids = vocabulary.encode(" ".join(sentence), len(sentence) + padding)
    assert [vocabulary.WORDS[i - 1] for i in ids[: len(sentence)]] == sentence
    assert (ids[: len(sentence)] != vocabulary.PAD).all()
    assert (ids[len(sentence) :] == vocabulary.PAD).all()
    np.testing.assert_array_equal(ids, vocabulary.encode(vocabulary.decode(ids), len(ids)))
    swap = {"left": "right", "right": "left"}
    expected = vocabulary.encode(" ".join(swap.get(w, w) for w in sentence), len(ids))
    np.testing.assert_array_equal(vocabulary.mirrored_words()[ids], expected)


@pytest.mark.parametrize(
    ("instruction", "unknown"), [("go to the pink ball", "pink"), ("go to the red ball!", "!")]
)
def test_unknown_word_error_names_the_word(instruction, unknown):
    with pytest.raises(UserError, match=f"unknown word '{unknown}'"):
        vocabulary.encode(instruction, 20)


def test_the_longest_instruction_of_the_grammar_fits():
    place = "the purple object in front of you"
    clause = f"put {place} next to {place}"
    longest = f"{clause} and {clause}, then {clause} and {clause}"
    ids = vocabulary.encode(longest, vocabulary.LONGEST)
    assert (ids != vocabulary.PAD).all() and vocabulary.decode(ids) == longest
