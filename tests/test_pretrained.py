"""Planners that were trained before, asked for something else."""

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


def test_a_planner_can_be_asked_for_another_return(tmp_path):
    folder = untrained_run(tmp_path, "--method", "dt")

    def energies(target):
        planner = pretrained.load(folder, target_return=target)
        domain = pretrained.make_domain(planner.specification)
        context = blank_context(domain, planner.specification.context)
        first = np.zeros(1, np.int32)

        @jax.jit
        def judge(params, context):
            memory = planner.energy.encode(params, context)
            return planner.energy.conditional(params, memory, first, first)

        asked = planner.specification.method_settings.target_return
        return asked, np.asarray(judge(planner.params, context))

    (usual, as_trained), (_, same), (asked, other) = map(energies, (None, 1.0, -3.0))
    assert (usual, asked) == (1.0, -3.0)
    np.testing.assert_array_equal(as_trained, same)
    finite = np.isfinite(other)  # the end action is not chosen
    assert np.abs(as_trained[finite] - other[finite]).max() > 1e-3
    with pytest.raises(UserError, match="target_return must be finite"):
        pretrained.load(folder, target_return=float("nan"))


def test_a_planner_says_how_it_searches_and_what_it_plays(tmp_path):
    folder = untrained_run(tmp_path, "--level", "GoToLocalS7N1", "--architecture", "paper")
    trained = pretrained.load(folder).specification
    search = dataclasses.replace(trained.planner, iterations=77, fill="confident")
    planner = pretrained.load(folder, search, level="GoToObjMazeS4R2")
    asked = planner.specification
    assert (asked.planner, asked.level) == (search, "GoToObjMazeS4R2")
    assert dataclasses.replace(asked, planner=trained.planner, level=trained.level) == trained
    # Its network counts as many steps of an episode as it has learned to.
    blank = blank_context(planner.domain, 0)
    assert jax.eval_shape(planner.energy.encode, planner.params, blank)
    with pytest.raises(UserError, match="this leap has not learned"):
        pretrained.load(folder, target_return=0.5)


def test_the_plan_for_an_environment_is_the_first_that_is_played():
    """And what is said of a planner is short."""
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


@pytest.mark.parametrize(("executed", "again"), [(None, False), (1, True)])
def test_plans_after_the_first_are_compiled_where_a_cache_is_used(
    executed, again, tmp_path, monkeypatch
):
    compiled = []
    monkeypatch.setattr(CompiledPlanner, "compile", lambda *given: compiled.append(given[3:]))
    planner = pretrained.load(untrained_run(tmp_path, "--architecture", "paper", "--context", "2"))
    planner.compile(40, executed)
    assert compiled == [(40, again)]
