"""Tables and figures show the rows of results."""

import dataclasses
import json
from pathlib import Path

from experiments import report
from experiments.common import figures
from experiments.tables import atari, babyai, puzzles
from experiments.tables.cells import format_beside, format_rate
from leapjax.configuration import hash_config, list_settings
from leapjax.domains.babyai.levels import LEVELS
from leapjax.presets import find_preset
from tests.programs import with_options


def row(
    level="GoToLocalS8N7", method="leap", name="leapjax", seed=0, rate=0.9, played=False,
    mean_length=6.0, domain="babyai", **options,
):  # fmt: skip
    """Makes the row of a run, or of its checkpoint played again, with the fields of tables."""
    config = with_options(find_preset(domain, level, method, name), options)
    config = dataclasses.replace(config, checkpoint=Path("runs/name") if played else None)
    return {
        "domain": domain, "level": level, "method": method, "preset": name, "seed": seed,
        "first_episode_seed": config.test_seed, "episodes": config.episodes,
        "successes": round(rate * config.episodes), "mean_length": mean_length,
        "train_steps": 0 if played else config.training.steps,
        "hash": hash_config(config, seed),
        "configuration": {"planner": dataclasses.asdict(config.planner)},
    }  # fmt: skip


ROWS = [
    row(), row(seed=1, rate=1.0), row("PickUpLoc", rate=0.3),
    # These do not count: other settings, other evaluation levels, a checkpoint played again.
    row(demos=50, rate=0), row(steps=1, rate=0), row(validation=True, rate=0),
    row(test_seed=5, rate=0), row(episodes=600, rate=0), row(played=True, rate=0),
]  # fmt: skip


def read_table(table):
    """Returns the cells of each line below the head of a Markdown table."""
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


def test_only_rows_of_a_setting_count_and_training_rows_are_preferred():
    lines = read_table(babyai.compare_settings(ROWS, babyai.SETTINGS))
    found = {level: cells for level, *cells in lines}["GoToLocalS8N7"]
    assert found[:5] == ["95.0%", "-", "-", "95.0% (90.0, 100.0), 2 seeds", "-"]


def test_each_setting_has_its_own_column():
    others = [
        row(name="paper", rate=0.8), row(name="paper", rate=0, masking="one"),
        row(method="random", rate=0.1), row(method="classifier", rate=0),
        row(played=True, executed=3, rate=1.0, mean_length=4.0),
        row(played=True, executed=1, rate=0), row(played=True, iterations=1, rate=0),
    ]  # fmt: skip
    lines = read_table(babyai.compare_settings([*ROWS, *others], babyai.SETTINGS))
    found = {level: cells for level, *cells in lines}["GoToLocalS8N7"]
    assert [cell.split("%")[0] for cell in found] == ["95.0", "10.0", "80.0", "95.0", "100.0"]


def test_intervals_above_or_below_the_published_number_are_marked():
    rows = [row(rate=0.9), row(seed=1, rate=0.9), row(seed=2, rate=0.9)]
    plain = format_rate(rows)
    assert plain.startswith("90.0% [") and plain.endswith("], 3 seeds")
    marks = [format_beside(rows, published).removeprefix(plain) for published in (80, 90, 99, None)]
    assert marks == [" ↑", "", " ↓", ""]
    assert format_rate([]) == format_beside([], 50) == "-"


def test_methods_are_compared_with_the_paper_and_the_best_is_bold(tmp_path):
    rows = [
        row(rate=0.9), row(method="bc", rate=1.0), row(method="bc", seed=1, rate=0.9),
        row(method="bc", name="paper", rate=0.2), row("PickUpLoc"),
        row(method="dt", steps=1, rate=1.0),  # other steps than the preset's
    ]  # fmt: skip
    lines = read_table(babyai.compare_methods(rows))
    found = {method: entries for _, method, *entries in lines}
    assert len(lines) == len(found) and tuple(found) == babyai.COMPARED  # rows of a single level
    published = [entries[0] for entries in found.values()]
    assert published == ["-", "61.5%", "63.0%", "71.5%", "63.5%", "45.0%", "81.5%", "95.0%"]
    assert found["bc"][1].startswith("**20.0% [") and found["bc"][1].endswith("1 seed ↓**")
    ours = [entries[3].split("%")[0] for entries in found.values()]
    assert ours == ["-", "**95.0", *"-----", "**90.0"]  # bc with two seeds, and leap
    assert all(report.is_used(r) for r in rows[:-1]) and not report.is_used(rows[-1])
    names, found = babyai.COMPARED, babyai.compute_success_by_method(rows)
    figures.draw_methods(found, names, tmp_path / "methods.png")
    assert (tmp_path / "methods.png").stat().st_size > 5_000
    everywhere = [row(level, method="bc", rate=0.5) for level in LEVELS]
    aggregated = babyai.compute_aggregates([*everywhere, row("PickUpLoc")])
    assert list(aggregated) == ["LEAP, published", "bc, preset `leapjax`"]  # others lack levels
    figures.draw_intervals(aggregated, tmp_path / "aggregate.png")
    assert (tmp_path / "aggregate.png").stat().st_size > 5_000


def level_row(play, rate):
    """Makes the row of a level that the planner of all levels played."""
    found = row("BabyAI", rate=rate, played=True, play=play)
    return found | {"played": play, "mean_success_length": 7.5 if rate else None}


def test_levels_are_sorted_by_whether_they_were_learned_then_by_success():
    unknown, hard, easy = "BabyAI-PickupDist-v0", "BabyAI-Unlock-v0", "BabyAI-GoTo-v0"
    rows = [level_row(easy, 1.0), level_row(hard, 0.0), level_row(unknown, 0.5)]
    bot = {"episodes": 200, "successes": 190, "mean_success_length": 5.0}
    lines = read_table(babyai.list_levels(rows, dict.fromkeys((unknown, hard, easy), bot)))
    assert [[cell.split(" [")[0] for cell in line] for line in lines] == [
        ["PickupDist (not learned)", "50.0%", "7.5", "95.0%", "5.0"],
        ["Unlock", "0.0%", "-", "95.0%", "5.0"],
        ["GoTo", "100.0%", "7.5", "95.0%", "5.0"],
    ]
    other = row("BabyAI", played=True, play=easy, validation=True) | {"played": easy}
    assert [report.is_used(each) for each in (*rows, other)] == [True] * 3 + [False]


def puzzle_row(level="Star3x5", method="leap", seed=0, rate=0.5, **options):
    """Makes the row of a level whose plans are executed whole."""
    domain = "stars" if level.startswith("Star") else "sudoku"
    config = with_options(find_preset(domain, level, method, "leapjax"), options)
    return {
        "domain": domain, "level": level, "method": method, "preset": "leapjax", "seed": seed,
        "first_episode_seed": config.test_seed, "episodes": 100, "successes": round(100 * rate),
        "iterations": config.planner.iterations, "train_steps": config.training.steps,
        "hash": hash_config(config, seed),
    }  # fmt: skip


# Options for a single plan, because the preset restarts.
MOST_CERTAIN = {"certainty": 1.0, "restarts": 1, "judge": "energy", "enough": None}


def board_row(rate, passes=81, boards=None, **options):
    """Makes the row of a planner that plays drawn boards, or all boards of a file."""
    if boards:
        options = {"episodes": puzzles.MIXTURE_BOARDS, **options}
    config = with_options(find_preset("sudoku", puzzles.HARD, "leap", "leapjax"), options)
    settings = json.loads(json.dumps(list_settings(config, 0)))
    settings["domain_settings"]["boards"] = boards
    row = puzzle_row(puzzles.HARD, rate=rate)
    return row | {"configuration": settings, "passes": passes, "hash": f"{rate}{passes}"}


def test_searches_are_compared_on_training_and_hard_boards():
    hard = puzzles.MIXTURE
    rows = [
        board_row(0.9, **MOST_CERTAIN), board_row(0.6, boards=hard, **MOST_CERTAIN),
        board_row(0.7, boards=hard, rules=1.0, **MOST_CERTAIN),
        board_row(0.5, passes=29.6, boards=hard, **MOST_CERTAIN | {"certainty": 0.999}),
        board_row(0.95, passes=38.2, boards=hard),
        # These do not count: another network, other boards, boards seen while choosing settings.
        board_row(0.8, boards=hard, layers=2), board_row(0, boards="other.txt 1234"),
        board_row(0, boards=hard, episodes=10), board_row(0, validation=True),
    ]  # fmt: skip
    older = rows[1]["configuration"]["planner"]
    del older["judge"], older["enough"]  # older rows lack these settings
    assert [report.is_used(row) for row in rows] == [True] * 5 + [False] * 4
    lines = read_table(puzzles.compare_boards([*rows, rows[0]]))  # a seed counts once
    assert lines[0][2].endswith("1 seed")
    assert [[cell.split(" ")[0] for cell in line] for line in lines] == [
        ["most", "81", "90.0%", "60.0%", "70.0%"],
        ["all", "30", "-", "50.0%", "-"],
        ["restarts", "38", "-", "95.0%", "-"],
    ]


def test_searches_are_compared_by_level_and_energy(tmp_path):
    rows = [
        puzzle_row(rate=1.0), puzzle_row(seed=1, rate=0.9),  # the search of the preset
        puzzle_row(rate=0.3, fill="together", iterations=10),
        puzzle_row(method="bc", rate=0.4),
        puzzle_row("Sudoku4x6", "rules", rate=0.6, fill="together", iterations=1),
        puzzle_row("Sudoku4x6", rate=0.7, rules=1.0, **MOST_CERTAIN),
        puzzle_row(rate=0.8, fill="margin", iterations=9),  # in no table
    ]  # fmt: skip
    assert [report.is_used(row) for row in rows] == [True] * 6 + [False]
    columns = ["Star3x5, learned", "Sudoku4x6, rules", "Sudoku4x6, learned and rules"]
    lines = read_table(puzzles.compare_searches(rows, columns))
    found = {tuple(line[:2]): [cell.split(" ")[0] for cell in line[2:]] for line in lines}
    assert found["most certain first", "T"] == ["95.0%", "-", "70.0%"]
    assert found["Gibbs sampling, random order", "2 T"] == ["30.0%", "-", "-"]
    assert found["all at once", "1"] == ["-", "60.0%", "-"]
    by_passes = puzzles.group_by_passes(rows)
    assert by_passes["Star3x5, learned"] == {
        "most certain first": {5: {"successes": 190, "episodes": 200}},
        "Gibbs sampling, random order": {10: {"successes": 30, "episodes": 100}},
    }
    figures.draw_iterations(by_passes, tmp_path / "searches.png")
    assert (tmp_path / "searches.png").stat().st_size > 0


def test_errors_come_from_games_and_seeds_and_of_greedy_play_from_seeds_alone():
    def read_scores(column, method, *means):
        found = [
            row("Pong", method, seed=seed, domain="atari")
            | {"mean_return": mean, "return_error": 1.2}
            for seed, mean in enumerate(means)
        ]
        lines = read_table(atari.compare_scores(found, {}))
        (score,) = (line[column] for line in lines if line[0] == "Pong" and "raw" in line[1])
        return score

    assert read_scores(2, "leap", 10.0) == "10.0 ± 1.2"
    assert read_scores(2, "leap", 10.0, 10.0) == "10.0 ± 0.8"  # the games' error is the floor
    assert read_scores(2, "leap", 10.0, 14.0) == "12.0 ± 2.0"  # of the seeds
    assert read_scores(6, "cql", 10.0) == "10.0"  # greedy games differ by their no-ops only
    assert read_scores(6, "cql", 10.0, 10.2) == "10.1 ± 0.1"
