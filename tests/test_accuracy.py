"""How much of demonstrations a model knows: against a model whose answers are known."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import accuracy
from leapjax.data.windows import Window
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from leapjax.energy import pseudo_likelihood
from leapjax.types import mask_token
from tests.programs import only_long, untrained_run

ACTIONS, HORIZON, END = 4, 5, 3
DOMAIN = BABYAI.make("GoToLocalS7N5", Settings())


def window(actions):
    every = jnp.ones(len(actions), bool)
    return Window(None, jnp.array(actions, jnp.int32), every, 0.0, ())  # no context is looked at


def counting_model():
    """Expects each action to be one more than the one before, and 0 at the start.

    It knows nothing where it cannot see the action before, and is put off by seeing a later one.
    """

    def logits(params, memory, tokens, positions):
        before = jnp.where(positions > 0, tokens[positions - 1], -1)
        expected = jnp.where(before < ACTIONS, (before + 1) % ACTIONS, 0)
        later = (jnp.arange(HORIZON) > positions[:, None]) & (tokens < mask_token(ACTIONS))
        expected = jnp.where(later.any(axis=1), ACTIONS - 1, expected)
        return 5.0 * (jnp.arange(ACTIONS) == expected[:, None])

    return pseudo_likelihood(lambda params, context: None, logits, ACTIONS)


def test_actions_are_predicted_from_those_before_and_none_after():
    right, counts = accuracy.find_hits(counting_model(), None, window([0, 1, 2, 0, 1]), end=True)
    np.testing.assert_array_equal(right, [True, True, True, False, True])
    assert counts.all()


@pytest.mark.parametrize("end", [True, False])
def test_what_comes_after_the_end_does_not_count(end):
    for third, known in ((2, True), (1, False)):  # the end is expected after 2 only
        model, plan = counting_model(), window([0, 1, third, END, END])
        right, counts = accuracy.find_hits(model, None, plan, end)
        np.testing.assert_array_equal(counts, [True, True, True, end, False])
        np.testing.assert_array_equal(right, [True, True, known, known and end, False])


def test_counts_are_those_of_every_step():
    """Three demonstrations of 2, 3 and 7 steps that count up from 0, or stand still."""
    whole = max(
        DOMAIN.demonstrations.collect(20, 0, print).demonstrations, key=lambda d: len(d.actions)
    )
    assert len(whole.actions) >= 7

    def told(actions):
        count = len(actions)
        return whole._replace(
            observations=Observation(*(part[: count + 1] for part in whole.observations)),
            actions=np.array(actions, np.int32),
            rewards=whole.rewards[:count],
        )

    data = [told([0, 1]), told([0, 1, 2]), told([0] * 7)]
    specification = SimpleNamespace(
        context=0, planner=SimpleNamespace(horizon=HORIZON),
        method_settings=SimpleNamespace(end=True),
    )  # fmt: skip
    planner = SimpleNamespace(specification=specification, energy=counting_model(), params=None)
    expected = np.zeros((2, HORIZON), int)
    for demonstration in data:
        for start in range(len(demonstration.actions)):
            ahead = [*demonstration.actions[start:], END][:HORIZON]
            for place, action in enumerate(ahead):
                expected[0, place] += action == (ahead[place - 1] + 1 if place else 0)
                expected[1, place] += 1
    np.testing.assert_array_equal(accuracy.count_hits(planner, data, 10**15), expected)


@only_long
def test_the_command_tells_what_was_learned_from_the_rest(tmp_path, monkeypatch, capsys):
    run = untrained_run(tmp_path / "run")
    assert accuracy.main([str(run), "--demos", "4", "--samples", "9"]) == 0
    said = capsys.readouterr().out
    assert "learned from" in said and "others" in said and "%" in said

    assert accuracy.main([str(run), "--demos", "0"]) == 2
    assert "--demos must be at least 1" in capsys.readouterr().err
    assert accuracy.main([str(untrained_run(tmp_path / "other", "--method", "random"))]) == 2
    assert "only leap masks actions" in capsys.readouterr().err
