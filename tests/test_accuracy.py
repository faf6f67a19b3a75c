"""Accuracy on demonstrations, of a model whose predictions are known."""

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
    imitated = jnp.ones(len(actions), bool)
    return Window(None, jnp.array(actions, jnp.int32), imitated, 0.0, ())  # no context needed


def counting_model():
    """Expects each action to be the previous action plus 1, and 0 at the start.

    It expects 0 after a masked action, and the end if it sees a later action.
    """

    def logits(params, memory, tokens, positions):
        before = jnp.where(positions > 0, tokens[positions - 1], -1)
        expected = jnp.where(before < ACTIONS, (before + 1) % ACTIONS, 0)
        later = (jnp.arange(HORIZON) > positions[:, None]) & (tokens < mask_token(ACTIONS))
        expected = jnp.where(later.any(axis=1), ACTIONS - 1, expected)
        return 5.0 * (jnp.arange(ACTIONS) == expected[:, None])

    return pseudo_likelihood(lambda params, context: None, logits, ACTIONS)


@pytest.mark.parametrize("end", [True, False])
def test_actions_after_the_end_do_not_count(end):
    for third, known in ((2, True), (1, False)):  # the model expects the end after 2 only
        model, plan = counting_model(), window([0, 1, third, END, END])
        right, counts = accuracy.find_hits(model, None, plan, end)
        np.testing.assert_array_equal(counts, [True, True, True, end, False])
        np.testing.assert_array_equal(right, [True, True, known, known and end, False])


def test_hits_are_counted_from_every_step():
    """Two demonstrations count up from 0, in 2 and 3 steps; the third repeats 0 for 7 steps."""
    longest = max(
        DOMAIN.demonstrations.collect(20, 0, print).demonstrations, key=lambda d: len(d.actions)
    )
    assert len(longest.actions) >= 7

    def make_demonstration(actions):
        count = len(actions)
        return longest._replace(
            observations=Observation(*(part[: count + 1] for part in longest.observations)),
            actions=np.array(actions, np.int32),
            rewards=longest.rewards[:count],
        )

    data = [make_demonstration([0, 1]), make_demonstration([0, 1, 2]), make_demonstration([0] * 7)]
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
def test_command_compares_learned_and_other_demonstrations(tmp_path, monkeypatch, capsys):
    run = untrained_run(tmp_path / "run")
    assert accuracy.main([str(run), "--demos", "4", "--samples", "9"]) == 0
    output = capsys.readouterr().out
    assert "learned from" in output and "others" in output and "%" in output

    assert accuracy.main([str(run), "--demos", "0"]) == 2
    assert "--demos must be at least 1" in capsys.readouterr().err
    assert accuracy.main([str(untrained_run(tmp_path / "other", "--method", "random"))]) == 2
    assert "only leap masks actions" in capsys.readouterr().err
