"""A custom domain goes through the same pipeline as BabyAI."""

import jax
import numpy as np
import pytest

import leapjax as leap
from leapjax import domains, methods, rollouts
from leapjax.data import storage
from leapjax.domain import blank_context
from leapjax.errors import UserError
from leapjax.presets import PRESETS
from leapjax.running import main as running
from leapjax.running import results
from leapjax.running.run import Experiment
from tests import frozen_lake
from tests.programs import LONG

LAKE = Experiment("lake", "frozen_lake")
COMMON = (
    "--steps 600 --batch 13 --demos 3 --episodes 5 --layers 1 --width 32 "
    "--heads 2 --learning-rate 0.01 --warmup 5 --no-pictures"
).split()  # options of every method
# Filling all positions at once would mix the many shortest paths.
TOY = [*COMMON, "--temperature", "0", "--fill", "confident"]


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(domains.DOMAINS, "frozen_lake", frozen_lake.FROZEN_LAKE)
    monkeypatch.setitem(PRESETS, "frozen_lake", {"leapjax": frozen_lake.preset})
    return tmp_path


def plan_first(planner):
    """Plans from the first state."""
    history = rollouts.History(np.zeros((), np.int64), planner.specification.context, 5)
    return planner(leap.plan_keys(0, np.zeros(1), np.zeros(1)), rollouts.stack_contexts([history]))


def test_leap_learns_a_custom_domain(workplace):
    assert running.main(LAKE, TOY) == 0
    (row,) = results.read(workplace / "runs" / "lake.jsonl")
    assert (row["domain"], row["level"]) == ("frozen_lake", frozen_lake.LEVEL)
    assert row["successes"] == row["episodes"] == 5
    assert row["mean_return"] == 1.0 and row["mean_length"] == 6.0  # a shortest path
    assert row["paper_success"] is None
    (folder,) = (path for path in (workplace / "runs").iterdir() if path.is_dir())
    planner = leap.load(folder)
    adapter = frozen_lake.make_adapter()
    adapter.reset(0)
    plan = plan_first(planner)
    for action in plan.actions[0]:
        assert not adapter.step(int(action)).terminated


def test_one_command_runs_every_method(workplace, monkeypatch, quick_begin):
    kept = methods.METHODS if LONG else ("iql", "plate", "random")
    for name in methods.METHODS.keys() - kept:
        excluded = methods.METHODS[name]._replace(everywhere=False)  # similar to the kept ones
        monkeypatch.setitem(methods.METHODS, name, excluded)
    arguments = [*COMMON, "--steps", "0", "--method", "all"]  # no gradients, which compile slowly
    assert running.main(LAKE, arguments) == 0
    rows = results.read(workplace / "runs" / "lake.jsonl")
    assert [row["method"] for row in rows] == [
        name for name, method in methods.METHODS.items() if method.everywhere
    ]
    for method in ("iql", "plate"):  # with a target network, and another planner
        (folder,) = (workplace / "runs").glob(f"*-{method}-*")
        plan = plan_first(leap.load(folder))
        assert plan.valid.all() and (plan.actions < 5).all()


def test_methods_that_learn_from_rewards_reject_data_without_rewards(
    workplace, capsys, quick_begin
):
    lake = frozen_lake.make(frozen_lake.LEVEL, frozen_lake.Settings())
    collection = lake.demonstrations.collect(3, 0, lambda done: None)
    for demonstration in collection.demonstrations:
        demonstration.rewards[:] = 0
    storage.save("mine/unrewarded-v0", collection, lake, "nothing is rewarded")
    arguments = [*COMMON, "--steps", "0", "--demonstrations", "mine/unrewarded-v0", "--method"]
    for method, rejected in (("dt", True), ("bc", False)):
        assert methods.METHODS[method].rewards == rejected
        assert running.main(LAKE, [*arguments, method]) == (2 if rejected else 0), method
        error = capsys.readouterr().err
        assert ("holds no rewards" in error and error.count("\n") == 1) == rejected


def test_contexts_of_another_domain_raise_an_error():
    lake = frozen_lake.make(frozen_lake.LEVEL, frozen_lake.Settings())
    blank = blank_context(lake, 3)
    with pytest.raises(UserError, match=r"context\.past has shape \(3,\), but .* \(1,\)"):
        leap.domain.check_context(blank, lake, 1)
    leap.domain.check_context(jax.tree.map(np.asarray, blank), lake, 3)
    scaled = blank._replace(observation=np.float32(0.5))
    with pytest.raises(UserError, match=r"context\.observation has numbers of type float32"):
        leap.domain.check_context(scaled, lake, 3)
