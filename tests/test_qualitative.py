"""Drawings of plans: watched episodes, and the program at toy size."""

import numpy as np
import pytest
from PIL import Image

from experiments import qualitative
from experiments.babyai_drawing import COLOURS, draw_picture, find_way
from experiments.common.episodes import watch_episode
from leapjax import pretrained, rollouts
from leapjax.domains.babyai.adapter import END, BabyAIAdapter
from leapjax.domains.babyai.levels import find_level
from leapjax.domains.babyai.observations import agent_cell
from leapjax.types import Plan
from tests.programs import only_long, untrained_run

LEVEL = find_level("GoToLocalS7N5")
FORWARD, RIGHT = 2, 1


@pytest.fixture(scope="module")
def planner(tmp_path_factory):
    return pretrained.load(untrained_run(tmp_path_factory.mktemp("run")), chunk_sizes=(8,))


@pytest.mark.parametrize("executed", [None, 2])
def test_watched_episodes_equal_evaluated_episodes(planner, executed):
    seeds = range(5)
    played = rollouts.evaluate(
        lambda: BabyAIAdapter(LEVEL), seeds, planner.plan, planner.params, context=0,
        seed=3, executed=executed,
    )  # fmt: skip
    plans = 0
    for row, level_seed in enumerate(seeds):
        adapter = BabyAIAdapter(LEVEL)
        events = list(watch_episode(adapter, planner, 0, level_seed, seed=3, executed=executed))
        steps = [event for event in events if not isinstance(event, Plan)]
        plans += len(events) - len(steps)
        assert len(steps) == played.lengths[row]
        succeeded = bool(steps) and steps[-1][1].success
        assert succeeded == played.successes[row]
    assert plans == played.plans


def test_the_way_of_a_plan_is_predicted_and_drawn():
    adapter = BabyAIAdapter(LEVEL)
    adapter.reset(0)
    turns = next(n for n in range(4) if len(set(find_way(adapter, [RIGHT] * n + [FORWARD]))) == 2)
    plan = [RIGHT] * turns + [FORWARD, END, FORWARD]
    before = agent_cell(adapter.env)
    cells = find_way(adapter, plan)
    assert agent_cell(adapter.env) == before == cells[0]  # `find_way` takes no action
    for action in plan[: turns + 1]:
        adapter.step(action)
    assert agent_cell(adapter.env) == cells[-1] and len(cells) == turns + 2
    plain = np.asarray(draw_picture(adapter, "text"))
    drawn = np.asarray(draw_picture(adapter, "text", [cells]))
    changed = drawn[(plain != drawn).any(axis=-1)]
    assert len(changed) > 30 and (changed == COLOURS[0]).all()


@only_long
def test_both_figures_are_drawn(tmp_path, monkeypatch):
    untrained = pretrained.load(untrained_run(tmp_path, "--level", "GoToBehindObstacles"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(qualitative, "STEPS", 0)  # any episode is long enough
    monkeypatch.setattr(qualitative, "ITERATIONS", (2,))
    monkeypatch.setattr(qualitative, "PLANNED", ("GoToLocalS7N5",))
    monkeypatch.setattr(qualitative, "ASKED", (("composition-easy", "sum"),))
    monkeypatch.setattr(qualitative.cases, "load_models", lambda *_: [untrained, untrained])
    assert qualitative.main(["--test-seed", "0"]) == 0
    first, second = (Image.open(tmp_path / "runs" / f"{name}.png") for name in qualitative.FIGURES)
    assert first.size == (2 * 336, 370) and second.size == (336, 370)
    frames = np.asarray(second).reshape(-1, 3)
    for colour in qualitative.HALVES:  # frames of each model's obstacles
        assert (frames == colour).all(axis=1).any()
