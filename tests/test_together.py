"""One planner plays many BabyAI levels: mixtures of levels, and training on parts of the data."""

import itertools
import json
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest

from experiments import babyai, demonstrator
from leapjax import load
from leapjax.data import seeds, windows
from leapjax.domains.babyai import demonstrations, levels
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.augmentation import mark_needed_cells
from leapjax.domains.babyai.levels import Level
from leapjax.running import results
from tests.programs import SINGLE, only_long

SMALL, LARGE = "BabyAI-GoToObjS4-v0", "BabyAI-PutNextS5N1-v0"  # sides 4 and 9, 4 and 5 words
TWO = Level("Two", members=(SMALL, LARGE))
TINY = [*SINGLE, *"--channels 4 --rounds 1 --fields 2 --sweeps 2 --word-heads 1".split()]


@pytest.fixture
def two(monkeypatch, tmp_path):
    monkeypatch.setitem(levels.MIXTURES, "Two", TWO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def test_training_levels_exclude_held_out_levels_and_their_debug_twins():
    members = set(levels.find_level("BabyAI").members)
    assert members | set(levels.HELD_OUT) == set(levels.registered_levels())
    for name in levels.HELD_OUT:
        stem = name.removesuffix("-v0")
        twins = {each for each in levels.registered_levels() if each.startswith(f"{stem}Debug")}
        assert not members & {name, *twins}
    assert set(levels.find_level("BabyAI10").members) < members and len(members) == 89


def test_mixture_plays_and_pads_a_member_for_each_seed():
    """Each episode equals the member's own episode, padded with zeros."""
    together = BabyAIAdapter(TWO)
    for seed in (5, 6, 8, 7):
        name = TWO.members[seed % 2]
        alone = BabyAIAdapter(levels.find_level(name))
        padded, plain = together.reset(seed), alone.reset(seed)
        for action in (2, 0, 2, 3):
            assert padded.grid.shape == (9, 9, 3)
            side = plain.grid.shape[0]
            np.testing.assert_array_equal(padded.grid[:side, :side], plain.grid)
            assert not padded.grid[side:].any() and not padded.grid[:, side:].any()
            for field in ("pose", "carried", "goal", "instruction"):
                np.testing.assert_array_equal(getattr(padded, field), getattr(plain, field))
            padded, plain = (each.step(action).observation for each in (together, alone))


def test_splitting_by_side_removes_only_padding():
    found = demonstrations.collect(TWO, 12, 0).demonstrations
    small, large = demonstrations.split_by_side(found)
    assert [len(small), len(large)] == [6, 6]
    for part, side, words in ((small, 8, 5), (large, 9, 10)):
        for each in part:
            (whole,) = (d for d in found if d.seed == each.seed)
            grid, text = each.observations.grid, each.observations.instruction
            assert grid.shape[1:3] == (side, side) and text.shape[1] <= words
            assert grid.sum() == whole.observations.grid.sum()
            assert text.sum() == whole.observations.instruction.sum()
        windows.concatenate(part, mark_needed_cells)  # raises unless all have one shape


def test_demonstrator_reports_the_results_of_each_level(two, capsys):
    """It plays the steps of demonstrations; an unsolved level has a result, too."""
    played = [SMALL, "BabyAI-KeyInBox-v0"]
    assert demonstrator.main(["--level", *played, "--episodes", "3"]) == 0
    solved, failed = json.loads(Path("runs/demonstrator.json").read_text()).values()
    adapter = BabyAIAdapter(levels.find_level(SMALL))
    played = seeds.test_seeds(seeds.UNSEEN, 3)
    found = [demonstrations.demonstrate(adapter, seed, Counter()) for seed in played]
    steps = [len(each.actions) for each in found]
    assert solved == {"episodes": 3, "successes": 3, "mean_success_length": np.mean(steps)}
    assert failed == {"episodes": 3, "successes": 0, "mean_success_length": None}
    assert demonstrator.main(["--level", "BabyAI-KeyInBoxx-v0"]) == 2
    assert "unknown level" in capsys.readouterr().err


@pytest.mark.parametrize("by", ["step", "episode"])
def test_parts_take_turns_in_proportion_to_their_windows(by):
    lengths = {"step": [4, 12, 48], "episode": [1, 1, 1]}[by]
    counts = {"step": [1, 1, 1], "episode": [1, 3, 12]}[by]
    parts = [
        windows.Steps(*[None] * 8, np.zeros(episodes), None, np.int32(length), None)
        for length, episodes in zip(lengths, counts, strict=True)
    ]
    choose = windows.take_turns(parts, by)
    number = {id(part): each for each, part in enumerate(parts)}
    chosen = [number[id(choose(step))] for step in range(1600)]
    for each, share in enumerate((1 / 16, 3 / 16, 12 / 16)):
        assert chosen.count(each) == pytest.approx(1600 * share, abs=3)
    gaps = [len(list(group)) for each, group in itertools.groupby(chosen) if each == 2]
    assert max(gaps) <= 8  # evenly spread


def test_paper_network_rejects_levels_of_several_sizes(two, capsys):
    arguments = [*SINGLE, "--level", "Two", "--preset", "paper", "--demos", "2"]
    assert babyai.main(arguments) == 2
    assert "Two has no encoder for architecture 'paper'" in " ".join(
        capsys.readouterr().err.split()
    )


@only_long
def test_planner_of_two_levels_plays_each_level_and_held_out_ones(two):
    """Two equal runs have equal parameters; a run reports a row for each level."""
    arguments = [*TINY, "--level", "Two", "--demos", "12", "--steps", "6"]
    assert babyai.main([*arguments, "--runs", "whole"]) == 0
    rows = results.read(Path("whole/babyai.jsonl"))
    assert [row["played"] for row in rows] == ["Two", SMALL, LARGE, *levels.HELD_OUT]
    assert babyai.main([*arguments, "--runs", "again"]) == 0
    (folder,), (other,) = (list(Path(runs).glob("babyai-*")) for runs in ("whole", "again"))
    same = load(folder).params, load(other).params
    jax.tree.map(np.testing.assert_array_equal, *same)
