"""Loaded planners: other targets, searches and levels, plans, and compilation."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest

import leapjax as leap
from leapjax import pretrained
from leapjax.batching import CompiledPlanner
from leapjax.domain import blank_context
from leapjax.errors import UserError
from tests.programs import untrained_run


def test_target_return_of_a_loaded_planner_changes_its_energies(tmp_path):
    folder = untrained_run(tmp_path, "--method", "dt")

    def load_energies(target):
        planner = pretrained.load(folder, target_return=target)
        domain = pretrained.make_domain(planner.specification)
        context = blank_context(domain, planner.specification.context)
        first = np.zeros(1, np.int32)

        @jax.jit
        def score_actions(params, context):
            memory = planner.energy.encode(params, context)
            return planner.energy.conditional(params, memory, first, first)

        chosen = planner.specification.method_settings.target_return
        return chosen, np.asarray(score_actions(planner.params, context))

    (default, as_trained), (_, same), (chosen, other) = map(load_energies, (None, 1.0, -3.0))
    assert (default, chosen) == (1.0, -3.0)
    np.testing.assert_array_equal(as_trained, same)
    finite = np.isfinite(other)  # the energy of the end action is infinite
    assert np.abs(as_trained[finite] - other[finite]).max() > 1e-3
    with pytest.raises(UserError, match="target_return must be finite"):
        pretrained.load(folder, target_return=float("nan"))


def test_a_planner_loaded_for_another_level_can_be_saved(tmp_path):
    folder = untrained_run(tmp_path, "--level", "GoToLocalS7N1", "--architecture", "paper")
    trained = pretrained.load(folder).specification
    search = dataclasses.replace(trained.planner, iterations=77, fill="confident")
    planner = pretrained.load(folder, search, level="GoToObjMazeS4R2")
    chosen = planner.specification
    assert (chosen.planner, planner.domain.level) == (search, "GoToObjMazeS4R2")
    assert "leap on GoToObjMazeS4R2, trained" in repr(planner)
    assert dataclasses.replace(chosen, planner=trained.planner) == trained
    planner.save(tmp_path / "saved")
    again = pretrained.load(tmp_path / "saved", level="GoToObjMazeS4R2")
    jax.tree.map(np.testing.assert_array_equal, again.params, planner.params)
    # The network keeps the number of episode steps of its training level.
    blank = blank_context(planner.domain, 0)
    assert jax.eval_shape(planner.energy.encode, planner.params, blank)
    with pytest.raises(UserError, match="this leap has not learned"):
        pretrained.load(folder, target_return=0.5)


def test_plan_for_returns_the_first_plan_of_an_episode():
    """The planner's `repr` begins with its method, level and data."""
    planner = leap.load("GoToLocalS7N5")
    adapter = planner.domain.make_adapter()
    plan = planner.plan_for(adapter, seed=3)
    assert plan.actions.shape == (5,) and plan.trace.shape == (5, 5)
    for action in itertools.takewhile(lambda action: action < 6, plan.actions):
        done = adapter.step(int(action)).terminated
    played = leap.evaluate(
        planner.domain.make_adapter, [3], planner.plan, planner.params, context=0
    )
    assert done and played.plans == 1
    assert played.lengths[0] == sum(plan.actions < 6)
    with pytest.raises(UserError, match="expected an Adapter"):
        planner.plan_for(3)
    level, *_ = repr(planner).splitlines()
    assert "leap on GoToLocalS7N5, trained on 500 demonstrations" in level


@pytest.mark.parametrize(("executed", "later_plans"), [(None, False), (1, True)])
def test_plans_after_the_first_are_compiled_if_they_use_a_cache(
    executed, later_plans, tmp_path, monkeypatch
):
    compiled = []
    monkeypatch.setattr(CompiledPlanner, "compile", lambda *given: compiled.append(given[3:]))
    planner = pretrained.load(untrained_run(tmp_path, "--architecture", "paper", "--context", "2"))
    planner.compile(40, executed)
    assert compiled == [(40, later_plans)]
