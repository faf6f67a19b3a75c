"""Sudoku: boards keep a unique solution under transformations; the rules are an energy."""

import copy
import functools
import hashlib
import itertools
import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import babyai, sudoku, sudoku_mixture
from experiments.common import searches
from leapjax.batching import compile_planner
from leapjax.configuration import hash_config, list_settings, make_domain, specify
from leapjax.data import seeds
from leapjax.domain import blank_context
from leapjax.domains.puzzles.sudoku import boards
from leapjax.domains.puzzles.sudoku.boards import Level, SudokuAdapter
from leapjax.domains.puzzles.sudoku.domain import BoardTokens, Settings, make
from leapjax.domains.puzzles.sudoku.rules import rules
from leapjax.energy import compose, symmetric
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.masked import build_masked_model
from leapjax.models.plans import make_attention_mask
from leapjax.planners import GibbsConfig
from leapjax.pretrained import describe_identity
from leapjax.running import results
from leapjax.running.command_line import parse
from leapjax.types import pad_token
from tests.parameters import random_like
from tests.programs import only_long
from tests.quick import quick_jit
from tests.toy import compile_augmentation

SMALL, LARGE = Level(4, 6, 6), Level(9, 36, 36)
LEVELS = pytest.mark.parametrize("level", [SMALL, LARGE], ids=str)


@functools.cache
def groups(side):
    """Returns the cells of each row, column and box: `[3 side, side]`."""
    cells, box = np.arange(side**2).reshape(side, side), {4: 2, 9: 3}[side]
    boxes = cells.reshape(box, box, box, box).swapaxes(1, 2).reshape(side, side)
    return np.concatenate([cells, cells.T, boxes])


def is_solved(digits, side):
    """Returns whether every group holds every digit."""
    return all(sorted(digits[group]) == list(range(1, side + 1)) for group in groups(side))


def test_search_finds_exactly_the_solutions():
    every = boards.find_solutions(np.zeros(16, np.int32), most=1000)
    assert len(every) == len({tuple(board) for board in every}) == 288  # the known number
    assert all(is_solved(board, 4) for board in every)
    assert boards.find_solutions(np.where(np.isin(np.arange(16), [0, 3]), 2, 0)) == []
    clues = "530070000600195000098000060800060003400803001700020006060000280000419005000080079"
    solution = "534678912672195348198342567859761423426853791713924856961537284287419635345286179"
    (found,) = boards.find_solutions(np.array(list(clues), int))  # a published board
    assert "".join(map(str, found)) == solution


@LEVELS
def test_drawn_boards_have_the_clues_of_the_level_and_one_solution(level):
    drawn = [boards.draw(level, seed) for seed in range(10)]
    for seed, (clues, solution) in enumerate(drawn):
        assert (clues > 0).sum() == level.fewest and is_solved(solution, level.side)
        np.testing.assert_array_equal(clues, np.where(clues > 0, solution, 0))
        (only,) = boards.find_solutions(clues)
        np.testing.assert_array_equal(only, solution)
        np.testing.assert_array_equal(boards.draw.__wrapped__(level, seed)[0], clues)
    assert len({tuple(clues) for clues, _ in drawn}) == 10


def test_seeds_draw_the_boards_of_recorded_rows():
    digest = hashlib.sha256()
    for level in (SMALL, LARGE, Level(9, 26, 26)):
        for seed in range(50):
            for board in boards.draw(level, seed):
                digest.update(board.tobytes())
    assert digest.hexdigest()[:16] == "f6ed6fdc74873327"


def test_range_draws_each_number_of_clues_equally_often():
    counts = []
    for seed in range(120):
        clues, solution = boards.draw(Level(4, 5, 8), seed)
        counts.append(int((clues > 0).sum()))
        same = boards.draw(Level(4, counts[-1], counts[-1]), seed)
        np.testing.assert_array_equal((clues, solution), same)
    assert np.bincount(counts)[5:].min() > 15 and set(counts) == {5, 6, 7, 8}


def read_digits(line):
    return np.array([int(digit) for digit in line.replace(".", "0")])


SEVENTEEN = "800000043000206000000000000000100670090530000000000200002003000500000900000040000"
# Published boards; a search of cells alone takes seconds to minutes.
UNSOLVABLE = ".....5.8....6.1.43..........1.5........1.6...3.......553.....61........4........."
BRUTE_FORCE = "..............3.85..1.2.......5.7.....4...1...9.......5......73..2.1........4...9"


@pytest.mark.parametrize(("line", "count"), [(SEVENTEEN, 1), (UNSOLVABLE, 0), (BRUTE_FORCE, 1)])
def test_sparse_and_unsolvable_boards_are_searched_quickly(line, count):
    begun = time.process_time()
    found = boards.find_solutions(read_digits(line))
    assert time.process_time() - begun < 5 and len(found) == count
    assert all(is_solved(solution, 9) for solution in found)


@pytest.mark.parametrize(
    ("board", "message"),
    [
        (np.zeros(80, int), r"16 or 81 digits, got shape \(80,\)"),
        (np.zeros((9, 9), int), r"16 or 81 digits, got shape \(9, 9\)"),
        (np.zeros(81), "must hold integers, got float64"),
        (np.full(16, 5), "run from 5 to 5, expected 0 to 4"),
        (np.full(81, -1), "run from -1 to -1, expected 0 to 9"),
    ],
)
def test_invalid_boards_raise_an_error(board, message):
    with pytest.raises(UserError, match=message):
        boards.find_solutions(board)


def test_solution_is_rewarded_and_a_wrong_digit_ends_the_episode():
    adapter = SudokuAdapter(4, functools.partial(boards.draw, SMALL))
    first = adapter.reset(1)
    assert (first.digits > 0).sum() == SMALL.fewest and first.cell == 0
    solution = adapter.solution
    steps = [adapter.step(int(action)) for action in solution]
    assert [step.terminated for step in steps] == [False] * 15 + [True]
    assert [step.reward for step in steps] == [0.0] * 15 + [1.0] and steps[-1].success
    np.testing.assert_array_equal(steps[-1].observation.digits, solution + 1)
    adapter.reset(1)
    step = adapter.step(int(solution[0] + 1) % 4)
    assert step.terminated and not step.success
    np.testing.assert_array_equal(step.observation.digits, first.digits)


@LEVELS
@pytest.mark.parametrize("cell", [0, 7])
def test_transformed_window_shows_another_solvable_board(level, cell):
    seen, rest = set(), level.cells - cell
    _, change = compile_augmentation("sudoku", f"Sudoku{level.side}x{level.fewest}")
    for seed, episode in itertools.product(range(4), range(2)):
        _, window = jax.device_get(change(jax.random.key(seed), episode * level.cells + cell))
        board, past = window.context.observation, window.context.past
        (solution,) = boards.find_solutions(board.digits)  # the open cells have one solution
        np.testing.assert_array_equal(window.actions[:rest] + 1, solution[cell:])
        assert (window.actions[rest:] == level.side).all()  # the end action
        assert board.cell == cell and (board.digits[:cell] > 0).all()
        clues = (board.digits[cell:] > 0).sum()
        assert clues <= level.fewest and (cell > 0 or clues == level.fewest)
        for back in (1, 2):
            if back > cell:
                assert window.context.actions[-back] == pad_token(level.side + 1)
                assert not past.digits[-back].any()
                continue
            assert window.context.actions[-back] + 1 == solution[cell - back]
            assert past.cell[-back] == cell - back
            after = past.digits[-back].copy()
            after[cell - back : cell] = board.digits[cell - back : cell]
            np.testing.assert_array_equal(after, board.digits)
        seen.add(tuple(board.digits))
    assert len(seen) == 8


def context_at(cell, digits):
    """Returns the context of a 4 by 4 board before cell `cell`."""
    board = boards.Board(np.asarray(digits, np.int32), np.int32(cell))
    return blank_context(make("Sudoku4x6", Settings()), 0)._replace(observation=board)


def test_plan_positions_encode_the_cells_they_fill():
    module, digits = BoardTokens(4, width=8), np.arange(16) % 5
    params = random_like(jax.eval_shape(module.init, jax.random.key(0), context_at(0, digits)))
    encode = functools.partial(module.apply, params, horizon=16, method="encode_positions")
    places = jax.jit(
        lambda cell: encode(context_at(0, digits)._replace(observation=boards.Board(digits, cell)))
    )
    tokens = module.apply(params, context_at(0, digits))
    assert tokens.shape == (17, 8)
    whole = np.asarray(places(0))
    np.testing.assert_array_equal(whole, tokens[:16])  # as the network sees each cell
    assert len(np.unique(whole, axis=0)) == 16
    for cell in (1, 7, 15, 16):  # the plan begins at the next cell; 16: a solved board
        np.testing.assert_array_equal(places(cell), np.roll(whole, -cell, axis=0))


@pytest.mark.parametrize("cell", [0, 6])
def test_attention_heads_see_rows_columns_boxes_or_the_whole_plan(cell):
    config, everywhere = ModelConfig(layers=1, heads=4, width=16), np.arange(16)
    module = build_masked_model(config, Sizes(5, 0, 16, 16), BoardTokens(4, 16))
    board = boards.Board(everywhere.astype(np.int32) % 5, np.int32(cell))
    context = context_at(cell, board.digits)._replace(observation=board)

    def score(module, plan):
        memory = module.encode(context)
        assert memory.known[0].keys.shape[0] == 1  # the positions of the plan show the cells
        return module.logits(memory, plan, everywhere)[:, :4]

    init = functools.partial(module.init, method=score)
    params = random_like(jax.eval_shape(init, jax.random.key(0), everywhere % 4))
    plans = np.where(np.eye(17, 16, -1), 3, 2)  # plan k + 1 differs at position k
    scores = quick_jit(jax.vmap(functools.partial(module.apply, method=score), (None, 0)))
    cells = (cell + everywhere) % 16
    for head in range(4):
        one_head = copy.deepcopy(params)
        value = one_head["params"]["transformer"]["blocks_0"]["value"]
        for leaf in value.values():
            leaf[..., everywhere // 4 != head] = 0  # silences the other heads
        seen = scores(one_head, plans)
        differs = np.abs(seen[1:] - seen[0]).max(axis=-1) > 1e-6  # [changed, position]
        kind = groups(4).reshape(3, 4, 4)[head] if head < 3 else [everywhere]
        together = [[any({a, b} <= {*group} for group in kind) for a in cells] for b in cells]
        np.testing.assert_array_equal(differs, together)


def test_too_few_heads_for_the_groups_raise_an_error():
    with pytest.raises(UserError, match="2 heads: .* use at least 4 heads"):
        make_attention_mask(ModelConfig(heads=2), 3, groups=jnp.ones((3, 3, 3), bool))


def count_conflicts(digits, side):
    """Counts pairs of cells with the same digit in a row, column or box."""
    pairs = {
        pair for group in groups(side) for pair in itertools.combinations(sorted(group.tolist()), 2)
    }
    return sum(digits[a] == digits[b] and digits[a] > 0 for a, b in pairs)


@pytest.mark.parametrize(("cell", "horizon"), [(0, 16), (7, 16), (7, 5)])
def test_energy_of_the_rules_counts_conflicts(cell, horizon):
    """The cells before `cell` are written already."""
    energy, rng = rules(4, weight=3.0), np.random.default_rng(0)
    clues, solution = boards.draw(SMALL, 0)
    written = np.where(np.arange(16) < cell, solution, clues)
    memory = quick_jit(energy.encode)((), context_at(cell, written))
    sum_energy, conditional = quick_jit(energy.total), quick_jit(energy.conditional)
    end = min(16, cell + horizon)
    clue, empty = (
        cell + np.flatnonzero(found) for found in (written[cell:end], written[cell:end] == 0)
    )

    def make_plan(digits):
        """Returns the plan that writes a board; it continues with 1 after the board's end."""
        return jnp.asarray(np.append(digits, np.ones(16))[cell : cell + horizon] - 1, int)

    assert float(sum_energy((), memory, make_plan(solution))) == 0
    for _ in range(10):
        board = np.where(written > 0, written, rng.integers(1, 5, 16))
        board[end:] = written[end:]
        total = float(sum_energy((), memory, make_plan(board)))
        assert total == pytest.approx(3.0 * count_conflicts(board, 4))
        # A conditional is the total with each digit in turn, up to a constant.
        where = int(rng.choice(empty))
        for others, plan in ((board, make_plan(board)), (written, jnp.full(horizon, 5))):  # MASK
            tried = [np.where(np.arange(16) == where, digit, others) for digit in range(1, 5)]
            totals = np.array([3.0 * count_conflicts(each, 4) for each in tried])
            found = np.asarray(conditional((), memory, plan, np.array([where - cell]))[0])
            np.testing.assert_allclose(found[:4] - found[0], totals - totals[0], rtol=1e-5)
            assert np.isinf(found[4])  # the end action
    changed = np.where(np.arange(16) == clue[0], solution % 4 + 1, solution)
    assert np.isinf(sum_energy((), memory, make_plan(changed)))
    after = jnp.arange(end - cell, horizon)  # positions beyond the board
    for row in np.asarray(conditional((), memory, make_plan(solution), after)):
        np.testing.assert_array_equal(row, [0.0] * 4 + [np.inf])


def test_rules_alone_solve_boards_by_confident_filling_or_by_sampling():
    clues, solution = map(np.stack, zip(*(boards.draw(SMALL, s) for s in range(40)), strict=True))
    contexts = jax.tree.map(
        lambda *leaves: np.stack(leaves), *(context_at(0, digits) for digits in clues)
    )
    keys = jax.random.split(jax.random.key(0), 40)

    def measure_success(energy, params, config):
        plan = compile_planner(energy, config, chunk_sizes=(40,))(params, keys, contexts)
        np.testing.assert_array_equal(np.where(clues > 0, plan.actions + 1, 0), clues)
        return (plan.actions + 1 == solution).all(axis=1).mean()

    certain = GibbsConfig(16, iterations=16, fill="confident")
    left_to_right = GibbsConfig(16, iterations=16, fill="sequential")
    refined = GibbsConfig(16, iterations=160, temperature=1.0, restarts=10)
    energy = rules(4)
    assert measure_success(energy, (), left_to_right) < measure_success(energy, (), certain)
    assert measure_success(energy, (), certain) > 0.9 and measure_success(energy, (), refined) > 0.9
    both = compose([energy, energy], [0.5, 0.5])
    assert measure_success(both, ((), ()), certain) == measure_success(energy, (), certain)


def test_turned_board_has_the_renamed_solution_and_the_same_energies():
    turn = functools.partial(boards.turn, side=4, horizon=18)  # two actions after the end
    energy, turn_context = symmetric(rules(4), turn), quick_jit(turn)
    conditional, turn_memory = quick_jit(energy.conditional), quick_jit(energy.turn)
    clues, solution = boards.draw(SMALL, 1)
    context, seen, rng = context_at(0, clues), set(), np.random.default_rng(0)
    plan = np.append(solution - 1, [4, 4])
    memory = energy.encode((), context)
    where, empty = jnp.arange(16), np.flatnonzero(clues == 0)
    for seed in range(8):
        key = jax.random.key(seed)
        turned = jax.tree.map(np.asarray, turn_context(key, context))
        (found,) = boards.find_solutions(turned.context.observation.digits)
        np.testing.assert_array_equal(
            found - 1, turned.names[turned.places, plan[turned.places]][:16]
        )
        seen.add(tuple(turned.context.observation.digits))
        # The rules treat all rows alike, so turning the board does not change them.
        tried = np.where(rng.random(18) < 0.4, 5, np.append(rng.integers(0, 4, 16), [0, 0]))  # MASK
        for tokens in (plan, tried):
            before, after = (
                conditional((), view, jnp.asarray(tokens), where)
                for view in (memory, turn_memory((), key, memory))
            )
            np.testing.assert_allclose(before[empty], after[empty], rtol=1e-6)
    assert len(seen) == 8


@pytest.mark.parametrize(("cell", "horizon"), [(3, 16), (0, 8)])
def test_plans_of_a_part_of_a_board_stay_unturned(cell, horizon):
    clues, solution = boards.draw(SMALL, 1)
    context = context_at(cell, np.where(np.arange(16) < cell, solution, clues))
    turned = boards.turn(jax.random.key(0), context, side=4, horizon=horizon)
    jax.tree.map(np.testing.assert_array_equal, turned.context, context)
    np.testing.assert_array_equal(turned.places, np.arange(horizon))
    np.testing.assert_array_equal(turned.names, np.tile(np.arange(5), (horizon, 1)))


def write_boards(folder, *lines):
    path = folder / "hard.txt"
    # With the mark that editors on Windows put before UTF-8.
    path.write_text("\ufeff# from a magazine\n\n" + "\n".join(lines) + "\n", "utf-8")
    return path


def make_lines(count):
    """Returns 4 by 4 boards as lines of text."""
    return ["".join(map(str, boards.draw(SMALL, seed)[0])) for seed in range(count)]


def test_held_out_episodes_play_the_boards_of_a_file_in_order(tmp_path):
    lines = make_lines(3)
    path = write_boards(tmp_path, lines[0], "", lines[1].replace("0", "."), f" {lines[2]} # hard")
    domain = make("Sudoku4x8-10", Settings(boards=path))
    adapter, first = domain.make_adapter(), seeds.UNSEEN
    domain.held_out.check(range(first, first + 3))
    for seed in range(3):
        clues, solution = boards.draw(SMALL, seed)
        np.testing.assert_array_equal(adapter.reset(first + seed).digits, clues)
        np.testing.assert_array_equal(adapter.solution, solution - 1)
    drawn = domain.demonstrations.collect(5, 0, lambda done: None).demonstrations
    counts = [(demonstration.observations.digits[0] > 0).sum() for demonstration in drawn]
    assert min(counts) >= 8 and max(counts) <= 10  # training draws boards of the level


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1" * 15, "line 4: 15 characters, expected 16: the cells of a 4 by 4 board"),
        ("5" + "0" * 15, "line 4: '5' is no cell of a board: expected 1 to 4, or 0 or . if open"),
        ("11" + "0" * 14, "line 4: the board has no solution, expected exactly one; correct"),
        ("." * 16, "line 4: the board has several solutions, expected exactly one; correct the"),
    ],
)
def test_error_names_the_invalid_line_of_a_board_file(line, message, tmp_path, capsys):
    path = write_boards(tmp_path, *make_lines(1), line)
    options = f"--level Sudoku4x6 --boards {path} --episodes".split()
    assert sudoku.main([*options, "2"]) == 2
    error = capsys.readouterr().err
    assert f"hard.txt, {message}" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--episodes", "4"], "boards for 3 of the 4 episodes: play at most 3"),
        (["--test-seed", "10000002", "--episodes", "2"], "has boards for 1 of the 2 episodes"),
        (["--test-seed", "0", "--episodes", "2"], "has no level of seed 0 (--test-seed"),
        (["--validation", "--episodes", "2"], "test levels of the seeds from 10000000 on"),
        (["--boards", "missing.txt"], "cannot read missing.txt"),
        (["--boards", os.devnull], "cannot read /dev/null: not a file"),
    ],
)
def test_invalid_episodes_or_board_files_are_one_error_line(options, message, tmp_path, capsys):
    path = write_boards(tmp_path, *make_lines(3))
    assert sudoku.main(["--level", "Sudoku4x6", "--boards", str(path), *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_contents_of_a_board_file_identify_rows_but_not_networks(tmp_path):
    folders = [tmp_path / name for name in "abc"]
    for folder, count in zip(folders, (3, 3, 2), strict=True):
        folder.mkdir()
        write_boards(folder, *make_lines(count))
    options = "--level Sudoku4x6 --episodes 2".split()
    plain, *configs = (
        parse("sudoku", [*options, *each])[0]
        for each in ([], *(["--boards", str(folder / "hard.txt")] for folder in folders))
    )
    names = [hash_config(config, 0) for config in (plain, *configs)]
    assert names[1] == names[2] and len(set(names)) == 3
    setting = list_settings(configs[0], 0)["domain_settings"]["boards"]
    assert setting == make_domain(configs[0]).held_out.name and setting.startswith("hard.txt ")
    specified = [specify(config, 0, make_domain(config)) for config in (plain, *configs)]
    assert len(set(map(describe_identity, specified))) == 1


def test_data_that_solve_no_board_raise_an_error():
    source = make("Sudoku4x6", Settings()).demonstrations
    states = source.collect(1, 0, lambda done: None).demonstrations[0].observations
    source.check(states, "here")
    swapped = states.digits.copy()
    swapped[-1] = swapped[-1] % 4 + 1  # another solution
    for wrong, message in (
        (states._replace(digits=states.digits + 1), "here: digits run from 1 to 5, expected 0"),
        (jax.tree.map(lambda x: x[:5], states), "here does not fill the 16 cells"),
        (states._replace(cell=states.cell[::-1]), "one after the other"),
        (states._replace(digits=np.ones_like(states.digits)), "a digit twice in a row"),
        (states._replace(digits=swapped), "changes a digit that stands on the board"),
    ):
        with pytest.raises(UserError, match=message):
            source.check(wrong, "here")


@only_long
def test_program_trains_and_plans_with_and_without_rules(tmp_path, monkeypatch, quick_begin):
    monkeypatch.chdir(tmp_path)
    (only,) = (search for search in searches.SEARCHES if search.name == "all at once")
    monkeypatch.setattr(searches, "SEARCHES", (only,))
    monkeypatch.setattr(searches, "BEST_OF_MANY", only)
    toy = "--level Sudoku4x8 --episodes 8 --no-pictures".split()
    network = "--steps 2 --demos 2 --batch 2 --width 8 --heads 4 --layers 1".split()
    assert sudoku.main([*toy, *network]) == 0
    (folder,) = (tmp_path / "runs").glob("sudoku-*")
    assert sudoku.main([*toy, "--checkpoint", str(folder), "--rules", "1"]) == 0
    assert sudoku.main([*toy, "--method", "rules"]) == 0
    path = write_boards(tmp_path, *make_lines(2))
    again = [*toy, "--checkpoint", str(folder), "--boards", str(path), "--episodes"]
    assert sudoku.main([*again, "2", "--level", "Sudoku4x8"]) == 0
    rows = results.read(tmp_path / "runs" / "sudoku.jsonl")
    found = [(row["method"], results.name_planner(row)) for row in rows]
    assert found == [
        ("leap", "N = 16, confident"), ("leap", "N = 1"), ("leap", "N = 16, confident, rules 1.0"),
        ("rules", "N = 16, confident"), ("rules", "N = 1"),
        ("leap", "N = 16, confident, learned Sudoku4x8"),
    ]  # fmt: skip
    # Eight clues leave few cells open. A network learns almost no Sudoku in two steps.
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
def test_unavailable_rules_are_one_error_line(program, arguments, message, capsys):
    assert program.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_mixture_adds_digits_of_the_solution_to_boards_of_17_clues(tmp_path, capsys):
    source, target = write_boards(tmp_path, *[SEVENTEEN] * 40), tmp_path / "mixture.txt"
    assert sudoku_mixture.main([str(source), str(target), "--count", "36"]) == 0
    made = np.array([read_digits(line) for line in target.read_text().split()])
    clues, (solution,) = read_digits(SEVENTEEN), boards.find_solutions(read_digits(SEVENTEEN))
    assert_equal = np.testing.assert_array_equal
    assert_equal((made > 0).sum(1), [*range(17, 35)] * 2)
    assert_equal(made[:, clues > 0], np.tile(clues[clues > 0], (36, 1)))
    assert_equal(made[made > 0], np.tile(solution, (36, 1))[made > 0])
    assert len(np.unique(made[17::18], axis=0)) == 2  # other cells each time
    assert sudoku_mixture.main([str(source), str(target), "--count", "41"]) == 2
    assert "has 40 boards: expected at least 41" in capsys.readouterr().err
    more = target.read_text().split()[1]
    assert (
        sudoku_mixture.main([str(write_boards(tmp_path, more)), str(target), "--count", "1"]) == 2
    )
    assert "line 3: 18 clues, expected 17" in capsys.readouterr().err
