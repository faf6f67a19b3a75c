"""`leap.fit` trains and saves planners."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

import leapjax as leap
from leapjax import fitting, pretrained
from leapjax.agents import leap as leap_agent
from leapjax.agents import mopo
from leapjax.agents.base import TrainingConfig
from leapjax.configuration import change, specify
from leapjax.domain import Demonstrations
from leapjax.models.config import ModelConfig
from leapjax.presets import find_preset
from tests import frozen_lake
from tests.parameters import make_begin

SMALL = ModelConfig(width=16, heads=2, layers=1, dropout=0.0)


@pytest.fixture(scope="module")
def star():
    """A domain and six demonstrations of it."""
    domain = leap.make_domain("stars", "Star2x3")
    return domain, domain.demonstrations.collect(6, 0, lambda count: None).demonstrations


def test_saved_planner_equals_the_fitted_planner(star, tmp_path):
    domain, data = star
    reports = []
    training = TrainingConfig(batch=4)
    planner = leap.fit(
        data, domain, steps=3, model=SMALL, training=training,
        progress=lambda step, means: reports.append((step, sorted(means))),
    )  # fmt: skip
    assert reports == [(3, ["accuracy", "gradient_norm", "loss"])]
    assert planner.specification.training == dataclasses.replace(training, steps=3)
    untrained = leap.fit(data, domain, steps=0, model=SMALL, training=training)
    other = leap.fit(data, domain, steps=0, model=SMALL, training=training, seed=1)
    assert not np.array_equal(*(jax.tree.leaves(p.params)[0] for p in (other, untrained)))
    assert leap.fit([], domain, "iql", steps=0, model=SMALL).specification.method == "iql"
    assert not np.array_equal(*(jax.tree.leaves(p.params)[0] for p in (planner, untrained)))
    planner.save(tmp_path / "mine")
    loaded = leap.load(tmp_path / "mine")
    jax.tree.map(np.testing.assert_array_equal, loaded.params, planner.params)
    assert loaded.specification == planner.specification and loaded.domain.level == "Star2x3"
    plans = [each.plan_for(each.domain.make_adapter(), seed=5) for each in (planner, loaded)]
    np.testing.assert_array_equal(*(plan.trace for plan in plans))
    pretrained.publish(str(tmp_path / "mine"), str(tmp_path / "small"))
    files = {path.name for path in (tmp_path / "small").iterdir()}
    assert files == {"specification.json", "weights.npz"}
    published = leap.load(tmp_path / "small")
    assert_close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-6)
    jax.tree.map(assert_close, published.params, planner.params)
    with pytest.raises(leap.UserError, match="is there already"):
        planner.save(tmp_path / "mine")


def test_planner_of_a_gymnasium_environment_saves_its_statistics(tmp_path):
    domain = leap.make_domain("gymnasium", "CartPole-v1")
    states = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    episode = leap.Demonstration(states, np.arange(5) % 2, np.ones(5, np.float32), False, True, 0)
    planner = leap.fit([episode], domain, "bc", steps=0, model=SMALL)
    assert planner.specification.statistics  # the network was built with them
    planner.save(tmp_path / "mine")
    loaded = leap.load(tmp_path / "mine")
    assert loaded.specification == planner.specification
    plans = [each.plan_for(each.domain.make_adapter(), seed=0) for each in (planner, loaded)]
    np.testing.assert_array_equal(*(plan.trace for plan in plans))


@pytest.mark.parametrize(
    ("domain", "level", "method"),
    [("babyai", "GoToLocalS7N5", "leap"), ("gymnasium", "CartPole-v1", "dt")],
)
def test_fit_uses_the_defaults_of_the_command_line(domain, level, method, monkeypatch):
    monkeypatch.setattr(fitting, "make_begin", make_begin)
    monkeypatch.setattr(fitting, "train", lambda step, state, *rest: state)
    made = leap.make_domain(domain, level)
    episode = leap.Demonstration(
        jax.tree.map(lambda x: np.zeros((3, *x.shape), x.dtype), made.blank),
        np.zeros(2, np.int32), np.ones(2, np.float32), True, False, 0,
    )  # fmt: skip
    made = made._replace(demonstrations=Demonstrations())
    fitted = leap.fit([episode], made, method).specification
    chosen = dataclasses.replace(find_preset(domain, level, method, "leapjax"), demos=1)
    if method == "dt":  # its target is the best return of the data
        chosen = change(chosen, method_settings={"target_return": 2.0, "return_scale": 2.0})
    assert dataclasses.replace(fitted, statistics=()) == specify(chosen, 0, made)


def test_planner_of_an_unregistered_domain_cannot_be_saved(monkeypatch, tmp_path):
    monkeypatch.setattr(fitting, "make_begin", make_begin)
    lake = frozen_lake.make(frozen_lake.LEVEL, None)
    data = lake.demonstrations.collect(2, 0, lambda count: None).demonstrations
    planner = leap.fit(data, lake, "bc", steps=0, model=SMALL)
    with pytest.raises(leap.UserError, match="cannot be saved"):
        planner.save(tmp_path / "mine")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda data: [], {}, "no demonstrations"),
        (lambda data: None, {}, "must be a list of Demonstration .* got NoneType"),
        (lambda data: [data[0]._replace(actions=[99])], {}, "demonstration 0: actions run from 99"),
        (lambda data: [data[0]._replace(rewards=[1])], {}, "demonstration 0: rewards of shape"),
        (lambda data: [data[0]._replace(observations=3)], {}, "has no observation 'edges'"),
        (lambda data: [data[0]._replace(terminated=[False, True])], {},
         "demonstration 0: terminated, one flag an episode, must be true or false"),
        (lambda data: [data[0]._replace(seed=None)], {}, "demonstration 0: seed must be"),
        (lambda data: [d._replace(rewards=0 * d.rewards) for d in data], {"method": "dt"},
         "no demonstration holds a reward"),
        (list, {"method": "lepa"}, "unknown method 'lepa'"),
        (list, {"steps": -1}, "steps must be at least 0"),
        (list, {"seed": 2**31}, "seed must be at most 2147483647"),
        (list, {"settings": SMALL}, "expected Settings, got ModelConfig"),
        (list, {"method": ["bc"]}, r"unknown method \['bc'\]"),
        (list, {"progress": None}, "progress must be a function"),
        (list, {"method": "iql", "settings": mopo.Settings()},
         r"expected leapjax.agents.iql.Settings, got leapjax.agents.mopo.Settings"),
        (list, {"method": "iql", "settings": leap_agent.Settings()},
         r"expected leapjax.agents.iql.Settings, got leapjax.agents.leap.Settings"),
        (list, {"horizon": 9, "planner": leap.GibbsConfig(9, 9)}, "horizon is 9, longer than any"),
        (list, {"context": 99}, "context is 99, longer than any"),
        (list, {"horizon": 9}, "it needs 9 iterations"),
        (list, {"method": "bc", "planner": leap.GibbsConfig(2)}, "horizon is 1"),
    ],
)  # fmt: skip
def test_invalid_arguments_fail_before_training(change, options, message, star, monkeypatch):
    monkeypatch.setattr(fitting, "train", lambda *given: pytest.fail("trained"))
    domain, data = star
    with pytest.raises(leap.UserError, match=message):
        leap.fit(change(data), **{"domain": domain, **options})
