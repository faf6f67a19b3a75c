"""Runs: consecutive windows that form one example, so that each state is encoded once."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.agents import bc, cql, leap
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.agents.batches import run_batches
from leapjax.data import windows
from leapjax.domain import Augmentations
from leapjax.domains.babyai.encoders import state_tokens as babyai
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig
from tests import mixed, toy
from tests.parameters import random_state
from tests.programs import only_long
from tests.quick import quick_jit

CONTEXT, HORIZON, RUN = 2, 3, 4
MODEL = ModelConfig(architecture="paper", layers=1, heads=2, width=16, dropout=0.0)
TRAINING = TrainingConfig(steps=10, batch=12, consecutive=RUN, windows="step")


def setup(run=RUN, domain=mixed.DOMAIN, **settings) -> Setup:
    training = dataclasses.replace(TRAINING, consecutive=run)
    chosen = leap.Settings(masking="each", **settings)
    return Setup(domain, CONTEXT, HORIZON, MODEL, training, chosen)


@pytest.fixture(scope="module")
def data():
    return jax.tree.map(jnp.asarray, windows.concatenate(toy.demonstrations()))


@pytest.fixture(scope="module")
def runs(data):
    return quick_jit(run_batches(setup()))(jax.random.key(0), data)


def test_windows_of_a_run_are_consecutive_and_stop_at_the_last(runs):
    steps, stopped = np.asarray(runs.context.step), 0
    assert steps.shape == (TRAINING.batch // RUN, RUN)
    for run, place in np.ndindex(len(steps), RUN - 1):
        before, now = (
            jax.tree.map(lambda x, at=(run, at): x[at], runs) for at in (place, place + 1)
        )
        if now.context.step == before.context.step:
            stopped += 1
            assert now.actions[1] == toy.END  # one action was left
            continue
        assert now.context.step == before.context.step + 1
        np.testing.assert_array_equal(now.context.past[-1], before.context.observation)
        assert now.context.actions[-1] == before.actions[0]
    assert stopped > 0 and len(np.unique(runs.context.observation[:, 0], axis=0)) > 1


@pytest.mark.parametrize("returns", [True, pytest.param(False, marks=only_long)])
def test_training_step_on_runs_equals_step_on_their_windows(returns, runs):
    agent = leap.make_agent(setup(returns=returns))
    separate = leap.make_agent(setup(run=1, returns=returns))
    state = random_state(agent)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), runs)
    together, metrics = quick_jit(agent.update)(state, runs, jax.random.key(1))
    one_by_one, expected = quick_jit(separate.update)(state, flat, jax.random.key(1))
    for name in ("loss", "accuracy", "gradient_norm"):
        assert float(metrics[name]) == pytest.approx(float(expected[name]), rel=1e-5)
    changed = 0.0
    for now, other, old in zip(
        *(jax.tree.leaves(s.optimizer) for s in (together, one_by_one, state)), strict=True
    ):
        np.testing.assert_allclose(now, other, rtol=1e-4, atol=1e-7)
        changed = max(changed, float(np.abs(np.asarray(now, float) - np.asarray(old)).max()))
    assert changed > 1e-3


def test_run_is_augmented_as_a_whole(data):
    def mark_window(key, window):
        return window._replace(return_to_go=jax.random.uniform(key))

    domain = mixed.DOMAIN._replace(augmentations=Augmentations([mark_window]))
    drawn = quick_jit(run_batches(setup(domain=domain)))(jax.random.key(0), data)
    marks = np.asarray(drawn.return_to_go)
    assert (marks == marks[:, :1]).all() and len(np.unique(marks)) == len(marks)


def test_runs_without_benefit_raise_an_error():
    with pytest.raises(ValueError, match="batch of 12 windows is not a multiple of 5"):
        dataclasses.replace(TRAINING, consecutive=5)
    single = setup()._replace(horizon=1)
    for method, made in (
        (leap.LEAP, setup()._replace(model=dataclasses.replace(MODEL, architecture="leapjax"))),
        (bc.BC, single._replace(settings=bc.Settings())),
        (cql.CQL, single._replace(settings=cql.Settings())),
    ):
        with pytest.raises(UserError, match="4 consecutive windows: only LEAP with architecture"):
            method.make_agent(made, None)
    encoders = {"paper": lambda model, sizes: babyai.StateTokens(7, model.width)}
    with pytest.raises(UserError, match="4 consecutive windows without repeated states"):
        leap.make_agent(setup(domain=mixed.DOMAIN._replace(encoders=encoders), repeat_state=False))
