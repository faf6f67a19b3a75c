"""Countdown: the verifier and the search agree with brute force; test targets are held out."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import countdown
from experiments.common import searches
from leapjax import pretrained
from leapjax.configuration import specify
from leapjax.data import seeds, windows
from leapjax.domain import blank_context
from leapjax.domains.puzzles.countdown import problems
from leapjax.domains.puzzles.countdown.domain import Settings, make
from leapjax.domains.puzzles.countdown.problems import (
    DIVIDE,
    END,
    LARGEST,
    MINUS,
    OPEN,
    PLUS,
    TIMES,
    CountdownAdapter,
    Level,
    write_equations,
)
from leapjax.errors import UserError
from leapjax.presets import find_preset
from leapjax.running import results
from leapjax.types import pad_token
from tests.parameters import make_leap_agent, random_parameters
from tests.programs import only_long
from tests.toy import compile_augmentation

assert_equal = np.testing.assert_array_equal


def apply(a, operation, b):
    """Computes the exact result of an operation, if the rules allow it."""
    if operation == PLUS:
        return a + b
    if operation == MINUS:
        return a - b if a >= b else None
    if operation == TIMES:
        return a * b
    return a // b if b > 0 and a % b == 0 else None


def enumerate_solutions(numbers):
    """Yields the equations of every solution of every target by brute force over all orders."""
    if len(numbers) == 1:
        yield []
        return
    for one, other in itertools.permutations(range(len(numbers)), 2):
        rest = [n for place, n in enumerate(numbers) if place not in (one, other)]
        for operation in (PLUS, MINUS, TIMES, DIVIDE):
            a, b = numbers[one], numbers[other]
            result = apply(a, operation, b)
            if result is not None and result <= LARGEST:
                for others in enumerate_solutions([*rest, result]):
                    yield [(a, operation, b, result), *others]


@settings(deadline=None, max_examples=30)
@given(st.lists(st.integers(1, 99), min_size=2, max_size=3) | st.lists(
    st.integers(1, 12), min_size=4, max_size=4))  # fmt: skip
def test_search_finds_a_solution_whenever_brute_force_does(numbers):
    reached = {equations[-1][-1] for equations in enumerate_solutions(numbers)}
    for target in range(101):
        found = problems.solve(numbers, target)
        assert (found is not None) == (target in reached)
        if found is not None:
            assert problems.is_solution(numbers, target, write_equations(found).tolist())
            assert found == problems.solve(numbers[::-1], target)
            assert all(a >= b for a, _, b, _ in found)


@pytest.mark.parametrize("numbers", [[2, 3], [4, 4], [6, 3, 2], [5, 5, 1], [1, 1, 1]])
def test_verifier_accepts_exactly_the_solutions(numbers):
    every = {tuple(equations): equations[-1][-1] for equations in enumerate_solutions(numbers)}
    written = {tuple(write_equations(e).tolist()): target for e, target in every.items()}
    assert len(written) == len(every)
    if len(numbers) == 2:  # try all equations of small numbers
        small, operations = range(18), (PLUS, MINUS, TIMES, DIVIDE)
        for equation in itertools.product(small, operations, small, small):
            tokens = write_equations([equation]).tolist()
            assert problems.is_solution(numbers, equation[-1], tokens) == ((equation,) in every)
    rng = np.random.default_rng(0)
    for tokens, target in written.items():
        assert problems.read_equations(tokens) is not None
        assert problems.is_solution(numbers, target, tokens)
        assert not problems.is_solution(numbers, target + 1, tokens)
        assert not problems.is_solution(numbers, target, tokens[:-1])
        changed = list(tokens)
        changed[rng.integers(len(changed))] = int(rng.integers(END + 1))
        for reached in {target, written.get(tuple(changed), target)}:
            legal = problems.is_solution(numbers, reached, changed)
            assert legal == (written.get(tuple(changed)) == reached)


def test_equations_are_written_digit_by_digit():
    equations = [(44, PLUS, 36, 80), (80, TIMES, 9, 720)]
    tokens = write_equations(equations).tolist()
    assert tokens == [0, 4, 4, PLUS, 0, 3, 6, 0, 8, 0, 0, 8, 0, TIMES, 0, 0, 9, 7, 2, 0]
    assert problems.read_equations(tokens) == list(map(list, equations))
    assert problems.read_equations(tokens[:17]) == [[44, PLUS, 36, 80], [80, TIMES, 9]]
    assert problems.read_equations(tokens[:12]) == [[44, PLUS, 36, 80], []]
    for wrong in ([PLUS], [0, 0, END], [0, 0, 4, 4]):
        assert problems.read_equations(wrong) is None


@pytest.mark.parametrize("name", ["Countdown2", "Countdown3", "Countdown4", "Countdown5"])
def test_problems_are_drawn_with_a_valid_solution(name):
    level, distinct = problems.find_level(name), set()
    for seed in range(12):
        problem, solution = problems.draw(level, seed)
        numbers, target = problem.numbers.tolist(), int(problem.target)
        assert len(numbers) == level.numbers and len(solution) == level.length
        assert min(numbers) >= 1 and max(numbers) <= 99 and 10 <= target <= 100
        assert problems.is_solution(numbers, target, solution.tolist())
        assert_equal(problem.written, [OPEN] * level.length)
        distinct.add((*numbers, target))
        again, _ = problems.draw.__wrapped__(level, seed)
        assert_equal(again.numbers, numbers)
    assert len(distinct) == 12


def test_training_validation_and_test_share_no_target():
    first = (0, 10_000_000, seeds.VALIDATION_START, seeds.TRAINING_START)
    test, also_test, validation, training = (set(problems.list_targets(seed)) for seed in first)
    assert test == also_test and test | validation | training == set(range(10, 101))
    assert len(test) == len(validation) == 8 and len(training) == 75
    for last_digits in ({target % 10 for target in targets} for targets in (test, validation)):
        assert len(last_digits) == 8
    for seed in (*range(30), *range(seeds.TRAINING_START, seeds.TRAINING_START + 30)):
        problem, _ = problems.draw(Level(3), seed)
        assert int(problem.target) in (training if seed >= seeds.TRAINING_START else test)


def play(adapter, seed, tokens):
    adapter.reset(seed)
    return [adapter.step(int(token)) for token in tokens]


def test_any_solution_is_rewarded_and_illegal_tokens_end_the_episode():
    level = Level(3)
    adapter = CountdownAdapter(level)
    problem, solution = problems.draw(level, 3)
    numbers, target = problem.numbers.tolist(), int(problem.target)
    every = [(write_equations(e), e[-1][-1]) for e in enumerate_solutions(numbers)]
    answers = [tokens for tokens, reached in every if reached == target]
    assert any((answer == solution).all() for answer in answers) and len(answers) > 1
    for answer in answers:
        steps = play(adapter, 3, answer)
        found = [(step.reward, step.terminated, step.success) for step in steps]
        assert found == [(0, False, False)] * 19 + [(1, True, True)]
        assert_equal(steps[-1].observation.written, answer)
    # Legal equations that reach another number fail.
    *before, last = play(adapter, 3, next(tokens for tokens, reached in every if reached != target))
    assert not any(step.terminated for step in before)
    assert last.terminated and not last.success and last.reward == 0
    for wrong in (PLUS, END):
        (step,) = play(adapter, 3, [wrong])
        assert step.terminated and not step.success and step.observation.place == 0
    absent = next(n for n in range(10, 100) if n not in numbers)
    operand = [0, absent // 10, absent % 10]  # the last digit ends the episode
    assert [step.terminated for step in play(adapter, 3, operand)] == [False] * 2 + [True]
    result = solution[:10].copy()
    result[9] = (result[9] + 1) % 10  # the arithmetic is wrong
    assert [step.terminated for step in play(adapter, 3, result)] == [False] * 9 + [True]


@pytest.mark.parametrize("numbers", [2, 3, 4, 5])
@pytest.mark.parametrize("place", [0, 1, -6])
def test_a_reordered_window_solves_the_same_problem(numbers, place):
    data, change = compile_augmentation("countdown", f"Countdown{numbers}")
    level, variants = Level(numbers), set()
    place %= level.length
    for seed, episode in itertools.product(range(8), range(4)):
        index = episode * level.length + place
        _, window = jax.device_get(change(jax.random.key(seed), index))
        problem, past = window.context.observation, window.context.past
        before = data[episode].observations
        assert_equal(problem.numbers, before.numbers[0])
        assert (problem.target, problem.place) == (before.target[0], place)
        rest = level.length - place
        solution = [*problem.written[:place].tolist(), *window.actions[:rest].tolist()]
        given, target = problem.numbers.tolist(), int(problem.target)
        assert problems.is_solution(given, target, solution)
        assert_equal(problem.written[place:], OPEN)
        assert_equal(window.actions[rest:], END)
        # The operations and their numbers stay.
        new, old = map(problems.read_equations, (solution, data[episode].actions.tolist()))
        assert sorted(map(sorted, new)) == sorted(map(sorted, old))
        for back in (1, 2):
            if back > place:
                assert window.context.actions[-back] == pad_token(END + 1)
                assert not past.numbers[-back].any() and not past.written[-back].any()
                continue
            assert window.context.actions[-back] == solution[place - back]
            assert_equal(past.written[-back][: place - back], solution[: place - back])
            assert_equal(past.written[-back][place - back :], OPEN)
            assert past.place[-back] == place - back
        variants.add((episode, *solution))
    assert len(variants) > 4 + (numbers > 3)  # some episodes have several orders


def test_only_independent_equations_are_reordered():
    level = Level(4)
    blank = blank_context(make("Countdown4", Settings()), 0)

    def sample_orders(*equations):
        solution = write_equations(equations)
        numbers = np.zeros(4, np.int32)
        problem = problems.Problem(numbers, np.int32(0), np.full(30, OPEN), np.int32(0))
        window = windows.Window(
            blank._replace(observation=problem), solution, np.ones(30, bool), 0.0, solution
        )
        window = jax.tree.map(jnp.asarray, window)
        change = jax.jit(jax.vmap(lambda key: problems.reorder(key, window).actions))
        found = np.asarray(change(jax.random.split(jax.random.key(0), 64)))
        assert found.shape == (64, level.length)
        read = [problems.read_equations(each.tolist()) for each in found]
        return {tuple(e[-1] for e in each) for each in read}, len(np.unique(found, axis=0))

    independent = sample_orders((9, MINUS, 2, 7), (8, TIMES, 3, 24), (24, PLUS, 7, 31))
    assert independent == ({(7, 24, 31), (24, 7, 31)}, 2 * 4)
    chain = sample_orders((9, MINUS, 2, 7), (7, TIMES, 3, 21), (21, DIVIDE, 1, 21))
    assert chain == ({(7, 21, 21)}, 2)


def test_network_ignores_the_order_of_the_given_numbers():
    domain = make("Countdown3", Settings())
    agent = make_leap_agent("countdown", domain)
    params, context = random_parameters(agent), blank_context(domain, 0)
    problem, _ = problems.draw(Level(3), 0)
    positions = np.arange(domain.max_steps)
    blank = np.full_like(positions, domain.num_actions)

    @jax.jit
    def energies(problem):
        memory = agent.energy.encode(params, context._replace(observation=problem))
        return agent.energy.conditional(params, memory, blank, positions)

    found = energies(problem)
    shuffled = problem._replace(numbers=problem.numbers[::-1])
    np.testing.assert_allclose(energies(shuffled), found, rtol=1e-4)
    other = problem._replace(target=problem.target + 1)
    assert np.abs(energies(other) - found)[np.isfinite(found)].max() > 1e-4


def test_network_has_fewer_than_a_million_parameters():
    config = find_preset("countdown", "Countdown5", "leap", "leapjax")
    domain = make("Countdown5", Settings())
    agent = pretrained.make_agent(specify(config, 0, domain), domain)
    params = jax.eval_shape(agent.init, jax.random.key(0)).params
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) < 1_000_000


def test_invalid_demonstrations_raise_an_error():
    source = make("Countdown3", Settings()).demonstrations
    (one,) = source.collect(1, 0, lambda done: None).demonstrations
    states = one.observations
    source.check(states, "here")
    written = states.written.copy()
    written[:, 9] = np.where(written[:, 9] == OPEN, OPEN, (written[:, 9] + 1) % 10)
    for wrong, message in (
        (states._replace(numbers=states.numbers + 99), "here: numbers run from .* expected 1 to"),
        (states._replace(written=states.written + 1), "here: written tokens run from"),
        (jax.tree.map(lambda x: x[:5], states), "here does not write 20 tokens"),
        (states._replace(place=states.place[::-1]), "one after the other"),
        (states._replace(target=states.target + 1), "here does not solve its problem"),
        (states._replace(written=written), "here does not solve its problem"),
    ):
        with pytest.raises(UserError, match=message):
            source.check(wrong, "here")


@only_long
def test_the_program_trains_and_plans(tmp_path, monkeypatch, quick_begin):
    monkeypatch.chdir(tmp_path)
    (only,) = (search for search in searches.SEARCHES if search.name == "all at once")
    monkeypatch.setattr(searches, "SEARCHES", (only,))
    toy = "--level Countdown3 --episodes 4 --no-pictures --steps 2 --demos 4 --batch 2".split()
    network = "--width 8 --heads 2 --layers 1".split()
    assert countdown.main([*toy, *network]) == 0
    assert countdown.main([*toy, *network, "--method", "bc"]) == 0
    rows = results.read(tmp_path / "runs" / "countdown.jsonl")
    found = [(row["method"], results.name_planner(row)) for row in rows]
    assert found == [("leap", "N = 20, confident"), ("leap", "N = 1"), ("bc", "N = 1, confident")]
