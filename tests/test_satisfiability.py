"""Satisfiability: formulas, episodes, rules and solvers agree with enumeration."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import satisfiability, satisfiability_solvers
from experiments.common import searches
from leapjax.agents.base import Setup
from leapjax.data import windows
from leapjax.domain import blank_context
from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.satisfiability.domain import Settings, make
from leapjax.domains.puzzles.satisfiability.formulas import OPEN, Formula, FormulaAdapter, Size
from leapjax.domains.puzzles.satisfiability.rules import rules
from leapjax.energy import symmetric
from leapjax.errors import UserError
from leapjax.methods import find_method
from leapjax.models.config import ModelConfig
from leapjax.presets import find_preset
from leapjax.running import results
from leapjax.types import pad_token
from tests.parameters import random_parameters
from tests.programs import only_long

SAT, NAE = Size(6, 20, differ=False), Size(6, 10, differ=True)
NAMES = {SAT: "Sat6x20", NAE: "Nae6x10"}
SIZES = pytest.mark.parametrize("size", [SAT, NAE], ids=NAMES.values())
MASK, END = 3, 2


def is_violated(clause, values, differ):
    """Whether a clause is violated for certain."""
    truths = [None if values[v // 2] > 1 else values[v // 2] == v % 2 for v in clause.tolist()]
    return truths == [False] * 3 or (differ and truths == [True] * 3)


def count(literals, values, size):
    """The number of violated clauses."""
    return sum(is_violated(clause, values, size.differ) for clause in literals)


def enumerate_solutions(literals, size):
    """All assignments without violated clauses."""
    every = itertools.product((0, 1), repeat=size.variables)
    return {values for values in every if not count(literals, values, size)}


@SIZES
def test_a_formula_has_different_clauses_and_the_solution_that_it_was_drawn_for(size):
    assert formulas.find_level(NAMES[size]) == size
    for seed in range(20):
        literals, solution = formulas.draw(size, seed)
        assert literals.shape == (size.clauses, 3)
        assert all(len(set(clause // 2)) == 3 for clause in literals)
        assert len({frozenset(clause) for clause in literals.tolist()}) == size.clauses
        assert tuple(solution) in enumerate_solutions(literals, size)
        np.testing.assert_array_equal(formulas.draw(size, seed)[0], literals)


@SIZES
def test_every_clause_that_a_solution_satisfies_can_be_drawn(size):
    every = Size(4, 4 * size.patterns, size.differ)  # all that one assignment satisfies
    literals, solution = formulas.draw(every, 0)
    assert len({frozenset(clause) for clause in literals.tolist()}) == every.clauses
    found = enumerate_solutions(literals, every)
    opposite = {tuple(1 - solution)} if size.differ else set()
    assert found == {tuple(solution)} | opposite


@SIZES
def test_the_demonstrated_solution_is_a_uniform_one_of_all(size):
    """So a network that imitates it learns the share of solutions that hold a value."""
    ranks = []
    for seed in range(1500):
        literals, solution = formulas.draw(size, seed)
        every = sorted(enumerate_solutions_fast(literals, size))
        if len(every) == 4:
            ranks.append(every.index(tuple(solution)))
    counts = np.bincount(ranks, minlength=4)
    assert len(ranks) > 60
    assert ((counts - len(ranks) / 4) ** 2).sum() / (len(ranks) / 4) < 16.3  # p = 0.001


def enumerate_solutions_fast(literals, size):
    """The same as `enumerate_solutions`, for many formulas."""
    every = np.array(list(itertools.product((0, 1), repeat=size.variables)))
    true = (every[:, literals // 2] == literals % 2).sum(axis=2)
    good = ((true > 0) & ((true < 3) | (not size.differ))).all(axis=1)
    return {tuple(values) for values in every[good].tolist()}


@SIZES
def test_exactly_the_solutions_succeed(size):
    adapter = FormulaAdapter(size)
    for seed in range(3):
        start = adapter.reset(seed)
        solutions = enumerate_solutions(start.literals, size)
        succeeded = set()
        for values in itertools.product((0, 1), repeat=size.variables):
            state, steps = adapter.reset(seed), 0
            assert state.variable == 0 and (state.values == OPEN).all()
            for value in values:
                step = adapter.step(value)
                steps += 1
                if step.terminated:
                    break
            assert step.terminated and step.reward == step.success
            known = np.where(np.arange(size.variables) < steps, values, OPEN)
            np.testing.assert_array_equal(step.observation.values, known)
            if step.success:
                assert steps == size.variables
                succeeded.add(values)
            else:  # it ends as soon as a clause is violated
                assert count(start.literals, known, size) > 0
                known[steps - 1] = OPEN
                assert count(start.literals, known, size) == 0
        assert succeeded == solutions


@functools.cache
def renamed(size):
    """Cuts the window at a step of a demonstration and renames it: compiled once."""
    domain = make(NAMES[size], Settings())
    data = domain.demonstrations.collect(2, 0, lambda done: None).demonstrations
    steps = jax.tree.map(jnp.asarray, windows.concatenate(data, domain.augmentations.extras))
    cut = functools.partial(windows.window, steps, context=2, horizon=size.variables, end=END)

    def both(key, index):
        return cut(index), formulas.rename(key, cut(index))

    return jax.jit(both)


@SIZES
@pytest.mark.parametrize("step", [0, 1, 4])
def test_a_renamed_window_is_that_of_a_formula_with_the_solutions_renamed(size, step):
    seen, rest = set(), size.variables - step
    for seed, episode in itertools.product(range(5), range(2)):
        pair = renamed(size)(jax.random.key(seed), episode * size.variables + step)
        before, window = jax.tree.map(np.asarray, pair)
        old, new = before.context.observation, window.context.observation
        # Which variable became which, and how: read from the clauses, whose order stays.
        pairs = np.unique(np.stack([old.literals, new.literals], -1).reshape(-1, 2), axis=0)
        to = dict(pairs.tolist())
        assert len(to) == len(set(to.values())) == len(pairs)
        assert all(to[literal] ^ 1 == to[literal ^ 1] for literal in to if literal ^ 1 in to)
        expected = set()
        for values in enumerate_solutions(old.literals, size):
            literals = [to.get(2 * v + a, to.get(2 * v + 1 - a, -1) ^ (2 * v + a not in to))
                        for v, a in enumerate(values)]  # fmt: skip
            expected.add(tuple(literal % 2 for literal in sorted(literals)))
        solutions = enumerate_solutions(new.literals, size)
        assert solutions == expected
        assert new.variable == step and (new.values[step:] == OPEN).all()
        assert (*new.values[:step].tolist(), *window.actions[:rest].tolist()) in solutions
        assert (window.actions[rest:] == END).all()
        for back in (1, 2):
            past = jax.tree.map(lambda leaf: leaf[-back], window.context.past)  # noqa: B023
            if back > step:
                assert window.context.actions[-back] == pad_token(3)
                assert not any(leaf.any() for leaf in past)
                continue
            assert window.context.actions[-back] == new.values[step - back]
            assert past.variable == step - back
            np.testing.assert_array_equal(past.literals, new.literals)
            known = np.where(np.arange(size.variables) < step - back, new.values, OPEN)
            np.testing.assert_array_equal(past.values, known)
        seen.add(new.literals.tobytes())
    assert len(seen) == 10


def at(size, formula):
    """The context of a formula."""
    return blank_context(make(NAMES[size], Settings()), 0)._replace(observation=formula)


def start(size, seed, known=0):
    """A formula whose first variables have the values of its solution."""
    literals, solution = formulas.draw(size, seed)
    values = np.where(np.arange(size.variables) < known, solution, OPEN).astype(np.int32)
    return Formula(literals, values, np.int32(known)), solution


@SIZES
@pytest.mark.parametrize(("known", "horizon"), [(0, 6), (2, 6), (2, 3)])
def test_the_energy_of_the_rules_weighs_violated_clauses(size, known, horizon):
    energy, rng = rules(size.differ, weight=3.0), np.random.default_rng(0)
    total, conditional = jax.jit(energy.total), jax.jit(energy.conditional)
    formula, solution = start(size, 0, known)
    memory, inside = energy.encode((), at(size, formula)), min(horizon, size.variables - known)

    def weigh(plan):
        values = formula.values.copy()
        values[known : known + inside] = plan[:inside]
        return 3.0 * count(formula.literals, values, size)

    planned = np.append(solution[known:], np.zeros(known, int))[:horizon]
    assert total((), memory, planned) == weigh(planned) == 0
    assert np.isinf(total((), memory, np.append(planned[1:], END)))
    for _ in range(20):
        plan = rng.choice([0, 1, MASK], horizon)  # an open literal violates no clause
        assert total((), memory, plan) == weigh(plan)
        position = int(rng.integers(inside))
        changed = [np.where(np.arange(horizon) == position, value, plan) for value in (0, 1)]
        (found,) = conditional((), memory, plan, np.array([position]))
        np.testing.assert_array_equal(found, [*map(weigh, changed), np.inf])
    both = np.array([0, inside - 1])  # two positions are masked together
    masked = np.where(np.isin(np.arange(horizon), both), MASK, planned)
    apart = np.array([conditional((), memory, masked, each[None])[0] for each in both])
    np.testing.assert_array_equal(conditional((), memory, planned, both), apart)
    for row in conditional((), memory, planned, np.arange(inside, horizon)):
        assert row[0] == row[1] < row[2] == np.inf  # after the last variable any value will do


@functools.cache
def turn(size, horizon):
    """The turn of a level: compiled once."""
    return jax.jit(functools.partial(make(NAMES[size], Settings()).turn, horizon=horizon))


@SIZES
def test_a_turned_formula_has_the_solutions_renamed(size):
    (formula, _), seen = start(size, 0), set()
    solutions = enumerate_solutions_fast(formula.literals, size)
    for seed in range(5):
        context, places, names = turn(size, 6)(jax.random.key(seed), at(size, formula))
        new, places, names = jax.tree.map(np.asarray, (context.observation, places, names))
        assert new.variable == 0 and (new.values == OPEN).all()
        assert sorted(places) == [*range(6)] and (np.sort(names) == [0, 1, END]).all()
        renamed = {tuple(names[t, values[t]] for t in places) for values in solutions}
        assert len(renamed) == len(solutions) > 0
        assert enumerate_solutions_fast(new.literals, size) == renamed
        seen.add(new.literals.tobytes())
    assert len(seen) == 5


@SIZES
def test_the_rules_weigh_a_plan_alike_for_each_turned_formula(size):
    horizon, rng = 8, np.random.default_rng(0)  # two positions are after the last variable
    plain = rules(size.differ)
    energy = symmetric(plain, turn(size, horizon))
    context, positions = at(size, start(size, 0)[0]), np.arange(horizon)

    @jax.jit
    def weigh(key, plan):
        memory = energy.turn((), key, energy.encode((), context))
        same = plain.encode((), context)
        return [
            (one.total((), seen, plan), one.conditional((), seen, plan, positions))
            for one, seen in ((energy, memory), (plain, same))
        ]

    totals = set()
    for seed in range(20):
        plan = rng.choice([0, 1, MASK], horizon, p=[0.4, 0.4, 0.2])
        found, expected = weigh(jax.random.key(seed), plan)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
        totals.add(float(expected[0]))
    assert len(totals) > 2  # so that an order the wrong way round is seen


@SIZES
@pytest.mark.parametrize(("known", "horizon"), [(1, 6), (0, 5)])
def test_a_formula_is_turned_only_for_plans_of_all_variables(size, known, horizon):
    context = at(size, start(size, 0, known)[0])
    turned = turn(size, horizon)(jax.random.key(0), context)
    jax.tree.map(np.testing.assert_array_equal, turned.context, context)
    np.testing.assert_array_equal(turned.places, np.arange(horizon))
    np.testing.assert_array_equal(turned.names, np.tile(np.arange(3), (horizon, 1)))


def make_agent(**model):
    config = find_preset("satisfiability", "Sat6x20", "leap", "leapjax")
    model = ModelConfig(layers=1, heads=2, width=16, dropout=0.0, **model)
    domain = make("Sat6x20", Settings(rounds=1))
    setup = Setup(domain, 0, SAT.variables, model, config.training, config.method_settings)
    return find_method("leap").make_agent(setup, None)


def test_the_network_sees_a_formula_and_no_order_of_clauses_literals_or_variables():
    agent, (formula, _) = make_agent(), start(SAT, 0)
    params, plan = random_parameters(agent), np.array([0, MASK, 1, MASK, 1, 0])

    @jax.jit
    def energies(literals, plan):
        memory = agent.energy.encode(params, at(SAT, formula._replace(literals=literals)))
        # One position at a time: those asked for together are masked together.
        ask = functools.partial(agent.energy.conditional, params, memory, plan)
        return jax.vmap(lambda position: ask(position[None])[0, :2])(np.arange(6))

    def ask(literals, plan=plan):
        return np.asarray(energies(literals, plan))

    literals = formula.literals
    found = ask(literals)
    same = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    same(ask(literals[::-1]), found)
    same(ask(literals[:, [1, 2, 0]]), found)
    places = np.array([0, 3, 1, 5, 2, 4])  # the first is marked: methods of one action assign it
    moved = np.empty_like(plan)
    moved[places] = plan
    same(ask(2 * places[literals // 2] + literals % 2, moved)[places], found)
    flipped = literals ^ (np.arange(3) == 0)
    for other in (ask(flipped), ask(literals, np.where(plan < 2, 1 - plan, plan))):
        assert np.abs(other - found).max() > 1e-3


def test_a_plan_later_in_an_episode_assigns_the_variables_from_there_on():
    """Its memory equals the one for variables counted from the next one on."""
    agent = make_agent()
    params, (formula, _) = random_parameters(agent, 0.3), start(SAT, 0, known=2)
    encode = jax.jit(lambda formula: agent.energy.encode(params, at(SAT, formula)).memory)
    rolled = formula._replace(
        literals=(formula.literals - 4) % 12, values=np.roll(formula.values, -2), variable=0
    )
    for later, first in zip(
        jax.tree.leaves(encode(formula)), jax.tree.leaves(encode(rolled)), strict=True
    ):
        np.testing.assert_allclose(later, first, rtol=1e-5, atol=1e-6)
    other = formula._replace(values=np.where(formula.values < 2, 1 - formula.values, OPEN))
    assert np.abs(encode(other).positions.tokens - encode(formula).positions.tokens).max() > 0.01


def test_no_action_sees_a_later_one_where_attention_is_causal():
    agent = make_agent(attention="causal")
    params, (formula, _) = random_parameters(agent, 0.3), start(SAT, 0)
    memory = agent.energy.encode(params, at(SAT, formula))
    conditional = jax.jit(agent.energy.conditional)
    plans = [np.array([0, MASK, 1, value, 1, 0]) for value in (0, 1)]
    found = [conditional(params, memory, plan, np.array([1])) for plan in plans]
    np.testing.assert_array_equal(*found)


@SIZES
def test_solvers_find_solutions_and_no_others(size):
    rng = np.random.default_rng(0)
    for seed in range(30):
        literals, _ = formulas.draw(size, seed)
        if seed % 2:  # any signs: many of these have no solution
            literals = literals ^ rng.integers(2, size=literals.shape, dtype=np.int32)
            literals = np.concatenate([literals, literals ^ (np.arange(3) == seed % 3)])
        every = enumerate_solutions_fast(literals, size)
        found = satisfiability_solvers.backtrack(literals, size).values
        assert tuple(found) in every if every else found is None
        walked = satisfiability_solvers.walk(literals, size, seed)
        assert tuple(walked.values) in every if every else walked.values is None
        assert every or walked.steps == satisfiability_solvers.FLIPS


def test_a_walk_does_not_start_at_the_solution_that_a_formula_was_drawn_for():
    size = formulas.find_level("Sat20x91")
    steps = [
        satisfiability_solvers.walk(formulas.draw(size, seed)[0], size, seed).steps
        for seed in range(10)
    ]
    assert min(steps) > 0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Sat20", "unknown level 'Sat20': expected Sat<variables>x<clauses> or"),
        ("sat20x91", "did you mean Sat20x91"),
        ("Sat2x3", r"level Sat2x3: variables must be in 3 .. 100, got 2"),
        ("Nae4x25", "level Nae4x25: at most 24 clauses exist, got 25"),
    ],
)
def test_unknown_levels_are_refused(name, message):
    with pytest.raises(UserError, match=message):
        formulas.find_level(name)


def test_data_that_satisfy_no_formula_are_refused():
    source = make("Sat6x20", Settings()).demonstrations
    states = source.collect(1, 0, lambda done: None).demonstrations[0].observations
    source.check(states, "here")
    for wrong, message in (
        (states._replace(literals=states.literals + 1), "here: literals run from . to 12"),
        (jax.tree.map(lambda x: x[:5], states), "here does not assign the 6 variables"),
        (states._replace(variable=states.variable[::-1]), "in order"),
        (states._replace(literals=states.literals ^ 1), "here does not satisfy its formula"),
    ):
        with pytest.raises(UserError, match=message):
            source.check(wrong, "here")


@only_long
def test_the_program_prints_searches_and_solvers(tmp_path, monkeypatch, capsys, quick_begin):
    monkeypatch.chdir(tmp_path)
    (only,) = (search for search in searches.SEARCHES if search.name == "all at once")
    monkeypatch.setattr(searches, "SEARCHES", (only,))
    monkeypatch.setattr(searches, "BEST_OF_MANY", only)
    toy = "--level Nae4x6 --episodes 8 --no-pictures".split()
    network = "--steps 2 --demos 2 --batch 2 --width 8 --heads 2 --layers 1".split()
    assert satisfiability.main([*toy, *network]) == 0
    assert satisfiability.main([*toy, "--method", "rules"]) == 0
    shown = capsys.readouterr().out
    assert "WalkSAT" in shown and "DPLL" in shown and "100.0%" in shown
    rows = results.read(tmp_path / "runs" / "satisfiability.jsonl")
    found = [(row["method"], results.name_planner(row)) for row in rows]
    assert found == [
        ("leap", "N = 4, confident"), ("leap", "N = 1"),
        ("rules", "N = 4, confident"), ("rules", "N = 1"),
    ]  # fmt: skip
    assert rows[2]["successes"] > rows[3]["successes"]
    assert satisfiability.main([*toy, "--preset", "paper"]) == 2
