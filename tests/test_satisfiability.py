"""Satisfiability: formulas, episodes, rules and solvers agree with enumeration."""

import functools
import itertools

import jax
import numpy as np
import pytest

from experiments import satisfiability, satisfiability_solvers
from experiments.common import searches
from leapjax.domain import blank_context
from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.satisfiability.domain import Settings, make
from leapjax.domains.puzzles.satisfiability.formulas import OPEN, Formula, FormulaAdapter, Size
from leapjax.domains.puzzles.satisfiability.rules import rules
from leapjax.energy import symmetric
from leapjax.errors import UserError
from leapjax.running import results
from leapjax.types import pad_token
from tests.parameters import make_leap_agent, random_parameters
from tests.programs import only_long
from tests.quick import quick_jit
from tests.toy import compile_augmentation

SAT, NAE = Size(6, 20, differ=False), Size(6, 10, differ=True)
NAMES = {SAT: "Sat6x20", NAE: "Nae6x10"}
SIZES = pytest.mark.parametrize("size", [SAT, NAE], ids=NAMES.values())
MASK, END = 3, 2


def is_violated(clause, values, differ):
    """Returns whether a clause is violated, whatever its open variables become."""
    truths = [None if values[v // 2] > 1 else values[v // 2] == v % 2 for v in clause.tolist()]
    return truths == [False] * 3 or (differ and truths == [True] * 3)


def count_violated(literals, values, size):
    return sum(is_violated(clause, values, size.differ) for clause in literals)


def enumerate_solutions(literals, size):
    """Returns all assignments that satisfy every clause."""
    every = np.array(list(itertools.product((0, 1), repeat=size.variables)))
    true = (every[:, literals // 2] == literals % 2).sum(axis=2)
    good = ((true > 0) & ((true < 3) | (not size.differ))).all(axis=1)
    return {tuple(values) for values in every[good].tolist()}


@SIZES
def test_formulas_have_distinct_clauses_and_their_drawn_solution(size):
    assert formulas.find_level(NAMES[size]) == size
    for seed in range(20):
        literals, solution = formulas.draw(size, seed)
        assert literals.shape == (size.clauses, 3)
        assert all(len(set(clause // 2)) == 3 for clause in literals)
        assert len({frozenset(clause) for clause in literals.tolist()}) == size.clauses
        assert tuple(solution) in enumerate_solutions(literals, size)
        np.testing.assert_array_equal(formulas.draw(size, seed)[0], literals)


@SIZES
def test_every_clause_that_the_solution_satisfies_can_be_drawn(size):
    every = Size(4, 4 * size.patterns, size.differ)  # all clauses that an assignment satisfies
    literals, solution = formulas.draw(every, 0)
    assert len({frozenset(clause) for clause in literals.tolist()}) == every.clauses
    found = enumerate_solutions(literals, every)
    opposite = {tuple(1 - solution)} if size.differ else set()
    assert found == {tuple(solution)} | opposite


@SIZES
def test_demonstrated_solution_is_uniform_among_all_solutions(size):
    """A network that imitates it thus learns the share of solutions with each value."""
    ranks = []
    for seed in range(1500):
        literals, solution = formulas.draw(size, seed)
        every = sorted(enumerate_solutions(literals, size))
        if len(every) == 4:
            ranks.append(every.index(tuple(solution)))
    counts = np.bincount(ranks, minlength=4)
    assert len(ranks) > 60
    assert ((counts - len(ranks) / 4) ** 2).sum() / (len(ranks) / 4) < 16.3  # p = 0.001


@SIZES
def test_episodes_succeed_exactly_for_solutions(size):
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
            else:  # the episode ends at the first violated clause
                assert count_violated(start.literals, known, size) > 0
                known[steps - 1] = OPEN
                assert count_violated(start.literals, known, size) == 0
        assert succeeded == solutions


@SIZES
@pytest.mark.parametrize("step", [0, 1, 4])
def test_renamed_windows_have_the_renamed_solutions(size, step):
    seen, rest = set(), size.variables - step
    _, change = compile_augmentation("satisfiability", NAMES[size])
    for seed, episode in itertools.product(range(5), range(2)):
        pair = change(jax.random.key(seed), episode * size.variables + step)
        before, window = jax.tree.map(np.asarray, pair)
        old, new = before.context.observation, window.context.observation
        # The new literal of each old literal, read from the clauses, whose order stays.
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


def observe(size, formula):
    return blank_context(make(NAMES[size], Settings()), 0)._replace(observation=formula)


def start(size, seed, known=0):
    """Draws a formula; its first `known` variables have the values of the solution."""
    literals, solution = formulas.draw(size, seed)
    values = np.where(np.arange(size.variables) < known, solution, OPEN).astype(np.int32)
    return Formula(literals, values, np.int32(known)), solution


@SIZES
@pytest.mark.parametrize(("known", "horizon"), [(0, 6), (2, 6), (2, 3)])
def test_energy_of_the_rules_weighs_violated_clauses(size, known, horizon):
    energy, rng = rules(size.differ, weight=3.0), np.random.default_rng(0)
    total, conditional = jax.jit(energy.total), jax.jit(energy.conditional)
    formula, solution = start(size, 0, known)
    memory, inside = energy.encode((), observe(size, formula)), min(horizon, size.variables - known)

    def weigh(plan):
        values = formula.values.copy()
        values[known : known + inside] = plan[:inside]
        return 3.0 * count_violated(formula.literals, values, size)

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
        assert row[0] == row[1] < row[2] == np.inf  # positions after the last variable are free


@functools.cache
def turn(size, horizon):
    """Compiles the turn of a level."""
    return jax.jit(functools.partial(make(NAMES[size], Settings()).turn, horizon=horizon))


@SIZES
def test_turning_does_not_change_the_energy_of_the_rules(size):
    horizon, rng = 8, np.random.default_rng(0)  # two positions are after the last variable
    plain = rules(size.differ)
    energy = symmetric(plain, turn(size, horizon))
    context, positions = observe(size, start(size, 0)[0]), np.arange(horizon)

    @jax.jit
    def weigh(key, plan):
        memory = energy.turn((), key, energy.encode((), context))
        same = plain.encode((), context)
        return [
            (one.total((), seen, plan), one.conditional((), seen, plan, positions))
            for one, seen in ((energy, memory), (plain, same))
        ]

    totals, turned = set(), set()
    for seed in range(20):
        plan = rng.choice([0, 1, MASK], horizon, p=[0.4, 0.4, 0.2])
        key = jax.random.key(seed)
        found, expected = weigh(key, plan)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
        totals.add(float(expected[0]))
        formula = turn(size, horizon)(key, context).context.observation
        assert formula.variable == 0 and (formula.values == OPEN).all()
        turned.add(np.asarray(formula.literals).tobytes())
    assert len(totals) > 2  # so that an inverted permutation fails
    assert len(turned) == 20


@SIZES
@pytest.mark.parametrize(("known", "horizon"), [(1, 6), (0, 5)])
def test_formulas_are_turned_only_for_plans_of_all_variables(size, known, horizon):
    context = observe(size, start(size, 0, known)[0])
    turned = turn(size, horizon)(jax.random.key(0), context)
    jax.tree.map(np.testing.assert_array_equal, turned.context, context)
    np.testing.assert_array_equal(turned.places, np.arange(horizon))
    np.testing.assert_array_equal(turned.names, np.tile(np.arange(3), (horizon, 1)))


make_agent = functools.partial(
    make_leap_agent, "satisfiability", make("Sat6x20", Settings(rounds=1))
)


def test_network_ignores_the_order_of_clauses_literals_and_variables():
    agent, (formula, _) = make_agent(), start(SAT, 0)
    params, plan = random_parameters(agent), np.array([0, MASK, 1, MASK, 1, 0])

    @jax.jit
    def energies(literals, plan):
        memory = agent.energy.encode(params, observe(SAT, formula._replace(literals=literals)))
        # One position at a time, because positions of a query are masked together.
        query = functools.partial(agent.energy.conditional, params, memory, plan)
        return jax.vmap(lambda position: query(position[None])[0, :2])(np.arange(6))

    def query(literals, plan=plan):
        return np.asarray(energies(literals, plan))

    literals = formula.literals
    found = query(literals)
    same = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    same(query(literals[::-1]), found)
    same(query(literals[:, [1, 2, 0]]), found)
    places = np.array([0, 3, 1, 5, 2, 4])  # 0 stays: it is marked for methods of one action
    moved = np.empty_like(plan)
    moved[places] = plan
    same(query(2 * places[literals // 2] + literals % 2, moved)[places], found)
    flipped = literals ^ (np.arange(3) == 0)
    for other in (query(flipped), query(literals, np.where(plan < 2, 1 - plan, plan))):
        assert np.abs(other - found).max() > 1e-3


def test_plans_later_in_an_episode_assign_the_remaining_variables():
    """Rolling the formula to begin with the next variable gives the same memory."""
    agent = make_agent()
    params, (formula, _) = random_parameters(agent, 0.3), start(SAT, 0, known=2)
    encode = jax.jit(lambda formula: agent.energy.encode(params, observe(SAT, formula)).memory)
    rolled = formula._replace(
        literals=(formula.literals - 4) % 12, values=np.roll(formula.values, -2), variable=0
    )
    for later, first in zip(
        jax.tree.leaves(encode(formula)), jax.tree.leaves(encode(rolled)), strict=True
    ):
        np.testing.assert_allclose(later, first, rtol=1e-5, atol=1e-6)
    other = formula._replace(values=np.where(formula.values < 2, 1 - formula.values, OPEN))
    assert np.abs(encode(other).positions.tokens - encode(formula).positions.tokens).max() > 0.01


def test_causal_attention_hides_later_actions():
    agent = make_agent(attention="causal")
    params, (formula, _) = random_parameters(agent, 0.3), start(SAT, 0)
    memory = quick_jit(agent.energy.encode)(params, observe(SAT, formula))
    conditional = quick_jit(agent.energy.conditional)
    plans = [np.array([0, MASK, 1, value, 1, 0]) for value in (0, 1)]
    found = [conditional(params, memory, plan, np.array([1])) for plan in plans]
    np.testing.assert_array_equal(*found)


@SIZES
def test_solvers_find_a_solution_if_one_exists(size):
    rng = np.random.default_rng(0)
    for seed in range(30):
        literals, _ = formulas.draw(size, seed)
        if seed % 2:  # any signs: many of these have no solution
            literals = literals ^ rng.integers(2, size=literals.shape, dtype=np.int32)
            literals = np.concatenate([literals, literals ^ (np.arange(3) == seed % 3)])
        every = enumerate_solutions(literals, size)
        found = satisfiability_solvers.backtrack(literals, size).values
        assert tuple(found) in every if every else found is None
        walked = satisfiability_solvers.walk(literals, size, seed)
        assert tuple(walked.values) in every if every else walked.values is None
        assert every or walked.steps == satisfiability_solvers.FLIPS


def test_walk_does_not_start_at_the_drawn_solution():
    size = formulas.find_level("Sat20x91")
    steps = [
        satisfiability_solvers.walk(formulas.draw(size, seed)[0], size, seed).steps
        for seed in range(10)
    ]
    assert min(steps) > 0


def test_invalid_demonstrations_raise_an_error():
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
def test_program_prints_searches_and_solvers(tmp_path, monkeypatch, capsys, quick_begin):
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
