"""How much of demonstrations a model knows: against a model whose answers are known."""

import jax.numpy as jnp
import numpy as np

from experiments import accuracy, babyai
from leapjax.data.windows import Window
from leapjax.energy import pseudo_likelihood
from leapjax.types import Context, mask_token
from tests.test_failures import TOY

ACTIONS, HORIZON = 4, 5


def window(actions):
    nothing = jnp.zeros(0)
    context = Context(nothing, nothing, nothing, jnp.int32(0))
    return Window(context, jnp.array(actions, jnp.int32), nothing)


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
    hits = accuracy.hits(counting_model(), None, window([0, 1, 2, 0, 1]))
    np.testing.assert_array_equal(hits, [True, True, True, False, True])


def test_the_demonstrations_of_both_kinds_are_different_levels():
    for seed in (0, 999):
        origin = accuracy.Origin("GoToLocalS7N5", seed, 4, None)
        learned = origin.learned(3, 7)
        others = origin.others(3)
        assert (len(learned), len(others)) == (3, 3)
        assert not {d.seed for d in learned} & {d.seed for d in others}
        assert len(origin.learned(9, 7)) == 4  # no more than there were


def test_the_command_tells_what_was_learned_from_the_rest(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LEAPJAX_COMPILATION_CACHE", "off")
    assert babyai.main(TOY) == 0
    (run,) = (path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    capsys.readouterr()
    assert accuracy.main([str(run), "--demos", "4", "--samples", "65"]) == 0
    said = capsys.readouterr().out
    assert "learned from" in said and "others" in said and "%" in said

    assert accuracy.main([str(run), "--demos", "0"]) == 2
    assert "--demos must be at least 1" in capsys.readouterr().err
    assert accuracy.main([str(tmp_path)]) == 2
    assert "not a checkpoint" in capsys.readouterr().err
    for broken, expected in (
        (b"[]", "JSON object"),
        (b"{}", "must be of type"),
        (b"{", "not valid"),
    ):
        (run / "config.json").write_bytes(broken)
        assert accuracy.main([str(run)]) == 2
        assert expected in capsys.readouterr().err


def test_no_run_is_an_error(capsys):
    assert accuracy.main([]) == 2
    assert "at least one folder" in capsys.readouterr().err
