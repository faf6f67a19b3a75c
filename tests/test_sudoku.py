"""Sudoku: boards have one solution, whatever is done to them; its rules as an energy."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import babyai, sudoku
from experiments.common import searches
from leapjax.batching import compile_planner
from leapjax.data import windows
from leapjax.domain import blank_context
from leapjax.domains.puzzles.sudoku import boards
from leapjax.domains.puzzles.sudoku.boards import Size, SudokuAdapter
from leapjax.domains.puzzles.sudoku.domain import BoardTokens, Settings, make
from leapjax.domains.puzzles.sudoku.rules import rules
from leapjax.energy import compose
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig
from leapjax.running import results
from leapjax.types import pad_token
from tests.parameters import random_like
from tests.programs import only_long

SMALL, LARGE = Size(4, 6), Size(9, 36)
SIZES = pytest.mark.parametrize("size", [SMALL, LARGE], ids=str)
DOMAIN = make("Sudoku4x6", Settings())
CLUES, SOLUTION = boards.draw(SMALL, 0)
same = np.testing.assert_array_equal


def groups(side):
    """Rows, columns and boxes, cell by cell: `[3 side, side]`."""
    box, cells = {4: 2, 9: 3}[side], np.arange(side**2).reshape(side, side)
    boxes = cells.reshape(box, box, box, box).swapaxes(1, 2).reshape(side, side)
    return np.concatenate([cells, cells.T, boxes])


def solved(digits, side):
    """Whether every group holds every digit."""
    return (np.sort(digits[groups(side)]) == np.arange(1, side + 1)).all()


def broken(digits, side=4):
    """Pairs of cells with the same digit in one row, column or box."""
    pairs = {pair for group in groups(side) for pair in itertools.combinations(sorted(group), 2)}
    return sum(digits[a] == digits[b] and digits[a] > 0 for a, b in pairs)


def context_of(digits, cell=0):
    context = blank_context(DOMAIN, 0)
    return context._replace(observation=boards.Board(np.asarray(digits), np.int32(cell)))


def test_the_search_finds_every_board_and_no_other():
    every = boards.find_solutions(np.zeros(16, np.int32), most=1000)
    assert len(every) == len({tuple(board) for board in every}) == 288  # as is known of 4 by 4
    assert all(solved(board, 4) for board in every)
    contradiction = np.zeros(16, np.int32)
    contradiction[[0, 3]] = 2
    assert boards.find_solutions(contradiction) == []


@SIZES
def test_boards_have_so_many_clues_and_one_solution(size):
    seen = set()
    for seed in range(10):
        clues, solution = boards.draw(size, seed)
        assert (clues > 0).sum() == size.clues
        assert (clues == np.where(clues > 0, solution, 0)).all() and solved(solution, size.side)
        (only,) = boards.find_solutions(clues)
        same(only, solution)
        seen.add(tuple(clues))
    assert len(seen) == 10


def test_the_solution_is_rewarded_and_a_wrong_digit_is_the_last():
    adapter = SudokuAdapter(SMALL)
    first = adapter.reset(1)
    assert (first.digits > 0).sum() == SMALL.clues and first.cell == 0
    steps = [adapter.step(int(digit) - 1) for digit in adapter.solution]
    assert [step.terminated for step in steps] == [False] * 15 + [True]
    assert [step.reward for step in steps] == [0.0] * 15 + [1.0] and steps[-1].success
    same(steps[-1].observation.digits, adapter.solution)
    same(adapter.reset(1).digits, first.digits)
    step = adapter.step(int(adapter.solution[0]) % 4)
    assert step.terminated and not step.success
    same(step.observation.digits, first.digits)


@functools.cache
def transformed(size):
    """The window at a cell of a demonstration, with another board: compiled once."""
    domain = make(f"Sudoku{size.side}x{size.clues}", Settings())
    data = domain.demonstrations.collect(2, 0, lambda done: None).demonstrations
    steps = jax.tree.map(jnp.asarray, windows.concatenate(data, domain.augmentations.extras))

    @jax.jit
    def draw(key, index):
        window = windows.window(steps, index, 2, size.cells, size.side)
        return boards.transform(key, window, size.side)

    return draw


@SIZES
@pytest.mark.parametrize("cell", [0, 7])
def test_a_transformed_window_is_that_of_another_board(size, cell):
    draw, seen, rest = transformed(size), set(), size.cells - cell
    for seed, episode in itertools.product(range(4), range(2)):
        window = draw(jax.random.key(seed), episode * size.cells + cell)
        window = jax.tree.map(np.asarray, window)
        board, past = window.context.observation, window.context.past
        assert board.cell == cell
        assert (window.actions[rest:] == size.side).all()  # the end action
        (solution,) = boards.find_solutions(board.digits)  # what is left has one solution
        same(window.actions[:rest] + 1, solution[cell:])
        assert (board.digits[:cell] > 0).all()
        clues = (board.digits[cell:] > 0).sum()
        assert clues <= size.clues and (cell > 0 or clues == size.clues)
        for back in (1, 2):
            if back > cell:
                assert window.context.actions[-back] == pad_token(size.side + 1)
                assert not past.digits[-back].any()
            else:
                assert window.context.actions[-back] + 1 == solution[cell - back]
                assert past.cell[-back] == cell - back
                after = past.digits[-back].copy()
                after[cell - back : cell] = board.digits[cell - back : cell]
                same(after, board.digits)
        seen.add(tuple(board.digits))
    assert len(seen) == 8


def test_a_position_of_a_plan_is_the_cell_that_it_fills():
    module, digits = BoardTokens(4, width=8), np.arange(16, dtype=np.int32) % 5
    params = random_like(jax.eval_shape(module.init, jax.random.key(0), context_of(digits)))
    encode = functools.partial(module.apply, horizon=16, method="encode_positions")
    places = jax.jit(functools.partial(encode, params))
    tokens = module.apply(params, context_of(digits))
    assert tokens.shape == (17, 8)
    whole = np.asarray(places(context_of(digits)))
    same(whole, tokens[:16])  # what the network sees of a cell
    assert len(np.unique(whole, axis=0)) == 16
    for cell in (1, 7, 15):  # later in an episode a plan begins there, and ends beyond the board
        same(places(context_of(digits, cell))[: 16 - cell], whole[cell:])
    assert np.isfinite(places(context_of(digits, 16))).all()  # a solved board


def test_the_energy_of_the_rules_counts_what_breaks_them():
    energy, rng = rules(4, weight=3.0), np.random.default_rng(0)
    memory = energy.encode((), context_of(CLUES))

    def total(digits):
        return float(energy.total((), memory, jnp.asarray(digits - 1)))

    def conditional(tokens, cell):
        return energy.conditional((), memory, jnp.asarray(tokens), jnp.array([cell]))[0]

    def totals(digits, cell):
        tried = [np.where(np.arange(16) == cell, digit, digits) for digit in range(1, 5)]
        return np.array([3.0 * broken(board) for board in tried])

    assert total(SOLUTION) == 0
    for _ in range(20):
        digits = np.where(CLUES > 0, CLUES, rng.integers(1, 5, 16))
        assert total(digits) == pytest.approx(3.0 * broken(digits))
        # A conditional is the total with each digit in turn, up to a constant.
        cell = int(rng.choice(np.flatnonzero(CLUES == 0)))
        found, expected = conditional(digits - 1, cell), totals(digits, cell)
        np.testing.assert_allclose(found[:4] - found[0], expected - expected[0], rtol=1e-5)
        assert np.isinf(found[4])  # the end action
        # What is MASK breaks nothing; a clue counts even where it is MASK.
        np.testing.assert_allclose(conditional(np.full(16, 5), cell)[:4], totals(CLUES, cell))
    clue = int(np.flatnonzero(CLUES)[0])
    assert np.isinf(total(np.where(np.arange(16) == clue, SOLUTION % 4 + 1, SOLUTION)))


@pytest.mark.parametrize("horizon", [16, 5])
def test_the_rules_continue_a_board_from_its_next_cell(horizon):
    """As the plan of the whole board does there, of which a part is written already."""
    energy, rng, at = rules(4), np.random.default_rng(0), 7
    written = np.where(np.arange(16) < at, SOLUTION, CLUES)
    here, whole = (energy.encode((), context_of(*b)) for b in ((written, at), (CLUES, 0)))
    on_board = np.arange(min(horizon, 16 - at))
    plan = np.where(np.arange(16) < at, SOLUTION - 1, rng.integers(0, 4, 16))
    plan[at + horizon :] = 5  # not planned: MASK
    rest = np.concatenate([plan[at:], np.full(16, 5)])[:horizon]
    found = energy.conditional((), here, jnp.asarray(rest), jnp.arange(horizon))
    expected = energy.conditional((), whole, jnp.asarray(plan), jnp.asarray(at + on_board))
    np.testing.assert_allclose(found[: len(on_board)], expected)
    for past in np.asarray(found[len(on_board) :]):  # the board is full
        same(past, [0.0] * 4 + [np.inf])
    right = np.zeros(horizon, int)
    right[: len(on_board)] = (SOLUTION - 1)[at : at + horizon]
    assert float(energy.total((), here, jnp.asarray(right))) == 0
    wrong, board = right.copy(), written.copy()
    wrong[np.flatnonzero(written[at : at + horizon] == 0)[0]] += 1
    wrong %= 4
    board[at : at + horizon] = (wrong + 1)[: len(on_board)]
    total = float(energy.total((), here, jnp.asarray(wrong)))
    assert total == pytest.approx(4.0 * broken(board)) and total > 0


def test_rules_alone_solve_boards_by_what_is_certain_or_by_sampling():
    drawn = [boards.draw(SMALL, seed) for seed in range(40)]
    clues, solution = (np.stack(part) for part in zip(*drawn, strict=True))
    contexts = jax.tree.map(lambda *x: np.stack(x), *map(context_of, clues))
    keys = jax.random.split(jax.random.key(0), 40)

    def share(energy, params, **config):
        plan = compile_planner(energy, GibbsConfig(16, **config), (40,))(params, keys, contexts)
        same(np.where(clues > 0, plan.actions + 1, 0), clues)
        return (plan.actions + 1 == solution).all(axis=1).mean()

    energy, certain = rules(4), {"iterations": 16, "fill": "confident"}
    alone = share(energy, (), **certain)
    assert alone > max(0.9, share(energy, (), iterations=16, fill="sequential"))
    assert share(energy, (), iterations=160, temperature=1.0, restarts=10) > 0.9
    assert share(compose([energy, energy], [0.5, 0.5]), ((), ()), **certain) == alone


def test_data_that_solve_no_board_are_refused():
    (demonstration,) = DOMAIN.demonstrations.collect(1, 0, lambda done: None).demonstrations
    states, check = demonstration.observations, DOMAIN.demonstrations.check
    check(states, "here")
    for wrong, message in (
        (states._replace(digits=states.digits + 1), "here: digits run from 1 to 5, expected 0"),
        (jax.tree.map(lambda x: x[:5], states), "here does not fill the 16 cells"),
        (states._replace(cell=states.cell[::-1]), "one after the other"),
    ):
        with pytest.raises(UserError, match=message):
            check(wrong, "here")


@pytest.fixture
def play(tmp_path, monkeypatch):
    """A program that searches in one way; the rows that it has left so far."""
    monkeypatch.chdir(tmp_path)
    (only,) = (search for search in searches.SEARCHES if search.name == "all at once")
    monkeypatch.setattr(searches, "SEARCHES", (only,))
    monkeypatch.setattr(searches, "BEST_OF_MANY", only)

    def run(options):
        toy = f"--level Sudoku4x8 --episodes 8 --no-pictures {options}"
        assert sudoku.main(toy.split()) == 0
        return results.read(tmp_path / "runs" / "sudoku.jsonl")

    return run


@only_long
def test_the_program_trains_and_plans_with_rules_and_without(tmp_path, play, quick_begin):
    play("--steps 2 --demos 2 --batch 2 --width 8 --heads 2 --layers 1")
    (folder,) = (path for path in (tmp_path / "runs").glob("sudoku-*"))
    play(f"--checkpoint {folder} --rules 1")
    rows = play("--method rules")
    found = [(row["method"], row["iterations"], results.name_planner(row)) for row in rows]
    assert found == [
        ("leap", 16, "N = 16, confident"), ("leap", 1, "N = 1"),
        ("leap", 16, "N = 16, confident, rules 1.0"),
        ("rules", 16, "N = 16, confident"), ("rules", 1, "N = 1"),
    ]  # fmt: skip
    # Eight clues leave little open. What two steps have learned is next to nothing.
    assert rows[2]["successes"] == rows[3]["successes"] == 8 > rows[0]["successes"]
    assert rows[3]["train_steps"] == rows[3]["demos"] == rows[3]["params"] == 0


@pytest.mark.parametrize(
    ("program", "arguments", "message"),
    [
        (babyai, ["--method", "rules"], "GoToLocalS7N5 has no rules that are written as an energy"),
        (babyai, ["--rules", "1"], "--rules: GoToLocalS7N5 has no rules"),
        (sudoku, ["--rules", "nan"], "--rules must be finite, got nan"),
    ],
)
def test_rules_that_cannot_be_had_are_one_line(program, arguments, message, capsys):
    assert program.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
