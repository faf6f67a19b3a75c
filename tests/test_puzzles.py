"""What holds for every puzzle: names of levels, augmented windows, and encoders."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leapjax.configuration import make_domain, specify
from leapjax.data import windows
from leapjax.domain import blank_context
from leapjax.domains.puzzles.countdown import problems
from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.sudoku import boards
from leapjax.errors import UserError
from leapjax.presets import find_preset
from leapjax.pretrained import make_agent
from leapjax.types import pad_token
from tests.parameters import random_parameters
from tests.programs import LONG

LEVELS = pytest.mark.parametrize(
    ("name", "level"),
    [
        ("stars", "Star2x3"), ("sudoku", "Sudoku4x6"), ("countdown", "Countdown3"),
        ("satisfiability", "Nae4x6"),
    ],
)  # fmt: skip


@LEVELS
@pytest.mark.parametrize("cut", [windows.window, windows.unrolled_window])
def test_augmented_windows_follow_the_rules_of_the_puzzle(name, level, cut):
    """Every action of a window leads from its state to the next, also in the plan's future."""
    domain, past, horizon = make_domain(find_preset(name, level, "leap", "leapjax")), 2, 4
    data = domain.demonstrations.collect(2, 0, lambda done: None).demonstrations
    steps = jax.tree.map(jnp.asarray, windows.concatenate(data, domain.augmentations.extras))
    end, count = domain.num_actions - 1, len(data[0].actions)
    (augment,) = domain.augmentations.functions
    change = jax.jit(lambda key, step: augment(key, cut(steps, step, past, horizon, end)))
    adapter = domain.make_adapter()
    adapter.reset(0)
    for step in {0, 1, count // 2, count - 2, count - 1}:
        window = jax.device_get(change(jax.random.key(step), count + step))
        context = window.context
        now = len(context.actions)
        states = [jax.tree.map(lambda x, j=j: x[j], context.past) for j in range(now)]
        states.append(context.observation)
        if name == "sudoku":  # its adapter compares digits with the solution
            adapter.solution = boards.find_solutions(context.observation.digits)[0] - 1
        taken = [*context.actions[:past], *window.actions]
        assert [*context.actions] == taken[:now]
        for place in range(now):
            if taken[place] == pad_token(domain.num_actions):
                assert place < past - step
                continue
            after = states[place]
            if taken[place] != end:
                after, _ = adapter.move(states[place], int(taken[place]))
            jax.tree.map(np.testing.assert_array_equal, after, states[place + 1])


@LEVELS
@pytest.mark.parametrize("method", ["leap", "classifier", "plate", "bc"])
def test_every_method_sees_the_puzzle(name, level, method):
    if not LONG and (name, method) not in (("sudoku", "classifier"), ("sudoku", "plate")):
        pytest.skip("long")
    config = find_preset(name, level, method, "leapjax")
    small = dataclasses.replace(config.model, width=16)
    config = dataclasses.replace(config, model=small, context=0)
    domain = make_domain(config)
    agent = make_agent(specify(config, 0, domain), domain)
    params, adapter = random_parameters(agent), domain.make_adapter()
    contexts = (
        blank_context(domain, 0)._replace(observation=adapter.reset(seed)) for seed in (1, 2)
    )
    actions, positions = jnp.zeros(config.planner.horizon, jnp.int32), jnp.zeros(1, jnp.int32)
    score = jax.jit(
        lambda context: agent.energy.conditional(
            params, agent.energy.encode(params, context), actions, positions
        )
    )
    first, second = map(score, contexts)
    assert not np.allclose(first[:, :-1], second[:, :-1], atol=1e-5)


@pytest.mark.parametrize(
    ("domain", "name", "message"),
    [
        (formulas, "Sat20", "unknown level 'Sat20': expected Sat<variables>x<clauses> or"),
        (formulas, "sat20x91", "did you mean Sat20x91"),
        (formulas, "Sat2x3", r"level Sat2x3: variables must be in 3 .. 100, got 2"),
        (formulas, "Nae4x25", "level Nae4x25: at most 24 clauses exist, got 25"),
        (graphs, "Star3", "unknown level 'Star3': expected Star<arms>x<edges of an arm>"),
        (graphs, "star3x5", "did you mean Star3x5"),
        (graphs, "Star100x100", "has 10001 nodes: at most 1000"),
        (problems, "Countdown", "unknown level 'Countdown': expected Countdown<2 to 5 numbers>"),
        (
            problems, "Countdown6",
            "expected Countdown<2 to 5 numbers>, such as Countdown3, Countdown4",
        ),
        (problems, "countdown4", "did you mean Countdown4"),
        (
            boards, "Sudoku9",
            "expected Sudoku<4 or 9>x<clues> or Sudoku<4 or 9>x<fewest>-<most clues>",
        ),
        (boards, "Sudoku9x17", "clues must be in 22 .. 81; .* too long to draw"),
        (boards, "Sudoku9x21-30", "clues must be in 22 .. 81"),
        (boards, "Sudoku4x6-17", "clues must be in 4 .. 16"),
        (boards, "Sudoku4x8-6", "the fewest clues come first: Sudoku4x6-8"),
    ],
)  # fmt: skip
def test_unknown_levels_raise_an_error(domain, name, message):
    with pytest.raises(UserError, match=message):
        domain.find_level(name)
