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


def groups(side):
    """Rows, columns and boxes, cell by cell: `[3 side, side]`."""
    box = {4: 2, 9: 3}[side]
    cells = [(r, c) for r in range(side) for c in range(side)]
    found: dict = {}
    for r, c in cells:
        for name in (("row", r), ("column", c), ("box", r // box, c // box)):
            found.setdefault(name, []).append(r * side + c)
    return np.array(list(found.values()))


def solved(digits, side):
    """Whether every group holds every digit."""
    return all(sorted(digits[group]) == list(range(1, side + 1)) for group in groups(side))


def test_the_search_finds_every_board_and_no_other():
    every = boards.find_solutions(np.zeros(16, np.int32), most=1000)
    assert len(every) == 288  # as is known of 4 by 4
    assert len({tuple(board) for board in every}) == 288
    assert all(solved(board, 4) for board in every)
    contradiction = np.zeros(16, np.int32)
    contradiction[[0, 3]] = 2
    assert boards.find_solutions(contradiction) == []


def test_the_search_finds_the_solution_of_a_published_board():
    clues = "530070000600195000098000060800060003400803001700020006060000280000419005000080079"
    solution = "534678912672195348198342567859761423426853791713924856961537284287419635345286179"
    (found,) = boards.find_solutions(np.array(list(clues), int))
    assert "".join(map(str, found)) == solution


@SIZES
def test_boards_have_so_many_clues_and_one_solution(size):
    seen = set()
    for seed in range(10):
        clues, solution = boards.draw(size, seed)
        assert (clues > 0).sum() == size.clues
        assert (clues == np.where(clues > 0, solution, 0)).all() and solved(solution, size.side)
        (only,) = boards.find_solutions(clues)
        np.testing.assert_array_equal(only, solution)
        seen.add(tuple(clues))
        np.testing.assert_array_equal(boards.draw(size, seed)[0], clues)
    assert len(seen) == 10


def test_the_solution_is_rewarded_and_a_wrong_digit_is_the_last():
    adapter = SudokuAdapter(SMALL)
    adapter.reset(1)
    solution = adapter.solution
    steps = [adapter.step(int(digit) - 1) for digit in solution]
    assert [step.terminated for step in steps] == [False] * 15 + [True]
    assert [step.reward for step in steps] == [0.0] * 15 + [1.0] and steps[-1].success
    np.testing.assert_array_equal(steps[-1].observation.digits, solution)
    first = adapter.reset(1)
    assert (first.digits > 0).sum() == SMALL.clues and first.cell == 0
    step = adapter.step(int(solution[0]) % 4)
    assert step.terminated and not step.success
    np.testing.assert_array_equal(step.observation.digits, first.digits)


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
    draw, seen = transformed(size), set()
    for seed, episode in itertools.product(range(4), range(2)):
        window = draw(jax.random.key(seed), episode * size.cells + cell)
        window = jax.tree.map(np.asarray, window)
        board, past = window.context.observation, window.context.past
        assert board.cell == cell
        rest = size.cells - cell
        assert (window.actions[rest:] == size.side).all()  # the end action
        (solution,) = boards.find_solutions(board.digits)  # what is left has one solution
        np.testing.assert_array_equal(window.actions[:rest] + 1, solution[cell:])
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
                np.testing.assert_array_equal(after, board.digits)
        seen.add(tuple(board.digits))
    assert len(seen) == 8


def test_a_position_of_a_plan_is_the_cell_that_it_fills():
    side, cells = 4, 16
    module = BoardTokens(side, width=8)
    digits = np.arange(cells, dtype=np.int32) % (side + 1)

    def context(cell):
        return blank_context(make("Sudoku4x6", Settings()), 0)._replace(
            observation=boards.Board(digits, np.int32(cell))
        )

    params = random_like(jax.eval_shape(module.init, jax.random.key(0), context(0)))
    encode = functools.partial(module.apply, horizon=cells, method="encode_positions")
    places = jax.jit(functools.partial(encode, params))
    tokens = module.apply(params, context(0))
    assert tokens.shape == (cells + 1, 8)
    whole = np.asarray(places(context(0)))
    np.testing.assert_array_equal(whole, tokens[:cells])  # what the network sees of a cell
    assert len(np.unique(whole, axis=0)) == cells
    for cell in (1, 7, 15):  # later in an episode a plan begins there, and ends beyond the board
        np.testing.assert_array_equal(places(context(cell))[: cells - cell], whole[cell:])
    assert np.isfinite(places(context(cells))).all()  # a solved board


def broken(digits, side):
    """Pairs of cells with the same digit in one row, column or box."""
    pairs = {
        pair for group in groups(side) for pair in itertools.combinations(sorted(group.tolist()), 2)
    }
    return sum(digits[a] == digits[b] and digits[a] > 0 for a, b in pairs)


def test_the_energy_of_the_rules_counts_what_breaks_them():
    energy, rng = rules(4, weight=3.0), np.random.default_rng(0)
    clues, solution = boards.draw(SMALL, 0)
    context = blank_context(make("Sudoku4x6", Settings()), 0)
    context = context._replace(observation=context.observation._replace(digits=clues))
    memory = energy.encode((), context)
    assert float(energy.total((), memory, jnp.asarray(solution - 1))) == 0
    empty = np.flatnonzero(clues == 0)
    for _ in range(20):
        digits = np.where(clues > 0, clues, rng.integers(1, 5, 16))
        total = float(energy.total((), memory, jnp.asarray(digits - 1)))
        assert total == pytest.approx(3.0 * broken(digits, 4))
        # A conditional is the total with each digit in turn, up to a constant.
        cell = int(rng.choice(empty))
        tried = [np.where(np.arange(16) == cell, digit, digits) for digit in range(1, 5)]
        totals = np.array([3.0 * broken(board, 4) for board in tried])
        found = energy.conditional((), memory, jnp.asarray(digits - 1), jnp.array([cell]))[0]
        np.testing.assert_allclose(found[:4] - found[0], totals - totals[0], rtol=1e-5)
        assert np.isinf(found[4])  # the end action
        # What is MASK breaks nothing; a clue counts even where it is MASK.
        blank = jnp.full(16, 5)
        found = energy.conditional((), memory, blank, jnp.array([cell]))[0]
        tried = [np.where(np.arange(16) == cell, digit, clues) for digit in range(1, 5)]
        np.testing.assert_allclose(found[:4], [3.0 * broken(board, 4) for board in tried])
    changed = solution.copy()
    clue = int(np.flatnonzero(clues)[0])
    changed[clue] = solution[clue] % 4 + 1
    assert np.isinf(energy.total((), memory, jnp.asarray(changed - 1)))


@pytest.mark.parametrize("horizon", [16, 5])
def test_the_rules_continue_a_board_from_its_next_cell(horizon):
    """As the plan of the whole board does there, of which a part is written already."""
    energy, rng = rules(4), np.random.default_rng(0)
    clues, solution = boards.draw(SMALL, 0)
    context = blank_context(make("Sudoku4x6", Settings()), 0)

    def memory(digits, cell):
        board = context.observation._replace(digits=digits, cell=np.int32(cell))
        return energy.encode((), context._replace(observation=board))

    at = 7
    written = np.where(np.arange(16) < at, solution, clues)
    plan = rng.integers(0, 4, 16)
    plan[:at] = solution[:at] - 1
    plan[at + horizon :] = 5  # not planned: MASK
    rest = np.concatenate([plan[at:], np.full(16, 5)])[:horizon]
    on_board = np.arange(min(horizon, 16 - at))
    whole = energy.conditional((), memory(clues, 0), jnp.asarray(plan), jnp.asarray(at + on_board))
    found = energy.conditional((), memory(written, at), jnp.asarray(rest), jnp.arange(horizon))
    np.testing.assert_allclose(found[: len(on_board)], whole)
    for past in np.asarray(found[len(on_board) :]):  # the board is full
        np.testing.assert_array_equal(past, [0.0] * 4 + [np.inf])
    right = np.zeros(horizon, int)
    right[: len(on_board)] = (solution - 1)[at : at + horizon]
    assert float(energy.total((), memory(written, at), jnp.asarray(right))) == 0
    first = int(np.flatnonzero(written[at : at + horizon] == 0)[0])
    wrong = right.copy()
    wrong[first] = (right[first] + 1) % 4
    board = written.copy()
    board[at : at + horizon] = (wrong + 1)[: len(on_board)]
    total = float(energy.total((), memory(written, at), jnp.asarray(wrong)))
    assert total == pytest.approx(4.0 * broken(board, 4)) and total > 0


def test_rules_alone_solve_boards_by_what_is_certain_or_by_sampling():
    domain = make("Sudoku4x6", Settings())
    drawn = [boards.draw(SMALL, seed) for seed in range(40)]
    clues, solution = (np.stack(part) for part in zip(*drawn, strict=True))
    blank = jax.tree.map(lambda x: np.stack([x] * 40), blank_context(domain, 0))
    contexts = blank._replace(observation=blank.observation._replace(digits=clues))
    keys = jax.random.split(jax.random.key(0), 40)

    def share(energy, params, config):
        plan = compile_planner(energy, config, chunk_sizes=(40,))(params, keys, contexts)
        kept = np.where(clues > 0, plan.actions + 1, 0)
        np.testing.assert_array_equal(kept, clues)
        return (plan.actions + 1 == solution).all(axis=1).mean()

    certain = GibbsConfig(16, iterations=16, fill="confident")
    left_to_right = GibbsConfig(16, iterations=16, fill="sequential")
    refined = GibbsConfig(16, iterations=160, temperature=1.0, restarts=10)
    energy = rules(4)
    assert share(energy, (), left_to_right) < share(energy, (), certain)
    assert share(energy, (), certain) > 0.9
    assert share(energy, (), refined) > 0.9
    both = compose([energy, energy], [0.5, 0.5])
    assert share(both, ((), ()), certain) == share(energy, (), certain)


def test_data_that_solve_no_board_are_refused():
    domain = make("Sudoku4x6", Settings())
    (demonstration,) = domain.demonstrations.collect(1, 0, lambda done: None).demonstrations
    states = demonstration.observations
    domain.demonstrations.check(states, "here")
    for wrong, message in (
        (
            states._replace(digits=states.digits + 1),
            "here: digits run from 1 to 5, expected 0 to 4",
        ),
        (jax.tree.map(lambda x: x[:5], states), "here does not fill the 16 cells"),
        (states._replace(cell=states.cell[::-1]), "one after the other"),
    ):
        with pytest.raises(UserError, match=message):
            domain.demonstrations.check(wrong, "here")


@pytest.fixture
def one_search(tmp_path, monkeypatch):
    """An empty folder to run in, and no more ways to search than one."""
    monkeypatch.chdir(tmp_path)
    (only,) = (search for search in searches.SEARCHES if search.name == "all at once")
    monkeypatch.setattr(searches, "SEARCHES", (only,))
    monkeypatch.setattr(searches, "BEST_OF_MANY", only)


@only_long
def test_the_program_trains_and_plans_with_rules_and_without(tmp_path, one_search, quick_begin):
    toy = "--level Sudoku4x8 --episodes 8 --no-pictures".split()
    network = "--steps 2 --demos 2 --batch 2 --width 8 --heads 2 --layers 1".split()
    assert sudoku.main([*toy, *network]) == 0
    (folder,) = (path for path in (tmp_path / "runs").glob("sudoku-*"))
    assert sudoku.main([*toy, "--checkpoint", str(folder), "--rules", "1"]) == 0
    assert sudoku.main([*toy, "--method", "rules"]) == 0
    rows = results.read(tmp_path / "runs" / "sudoku.jsonl")
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
        (sudoku, ["--rules", "-1"], "--rules must be at least 0, got -1.0"),
        (sudoku, ["--rules", "nan"], "--rules must be finite, got nan"),
    ],
)
def test_rules_that_cannot_be_had_are_one_line(program, arguments, message, capsys):
    assert program.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
