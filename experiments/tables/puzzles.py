"""The tables of puzzles, whose plans are executed whole, by search."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.common.searches import BEST_OF_MANY, SEARCHES
from experiments.tables.cells import format_rate, make_table
from experiments.tables.settings import Setting, select
from leapjax.configuration import list_settings
from leapjax.presets import find_preset
from leapjax.running.results import Row

LEARNED = ", learned"
MINIMISED = {
    LEARNED: Setting("leapjax"),
    ", rules": Setting("leapjax", "rules"),
    ", learned and rules": Setting("leapjax", changes={"rules": 1.0}),
}
ONE_ACTION = {(f"`--method {name}`", "T"): Setting("leapjax", name) for name in ("bc", "dt")}
PAYS_ON = (
    "Star3x5, learned", "Star5x10, learned", "Sat20x91, learned", "Sudoku9x36, learned",
    "Sudoku9x26, rules",
)  # fmt: skip
PAYING = (
    ("all at once", "1"), ("left to right", "T"), ("in random order", "T"),
    ("Gibbs sampling, random order", "2 T"), ("most certain first", "T"),
    ("all that are certain", "≤ T"), ("restarts on turned puzzles", "≤ 16 (T + 6)"),
    ("most certain first, best of 16", "16 (T + 1)"),
)  # fmt: skip
HARD = "Sudoku9x31-42"  # level in training; its planners also play the boards of a file:
MIXTURE, MIXTURE_BOARDS = "mixture.txt b48842797aed", 360  # name and hash of the file, its boards
TRAINED = ("model", "training", "method_settings")  # settings of a planner
ARMS_LEVEL, ARMS = "Star3x5", (2, 3, 5, 7, 9)  # level in training; arms of the levels played


def is_used(row: Row) -> bool:
    """Tells whether today's code makes such a row; tables and figures do not show every row."""
    return bool(group_by_search([row])) or any(
        of for _, by_count in [*group_by_arms([row]), *group_by_boards([row])] for of in by_count
    )


def compare_searches(rows: Sequence[Row], columns: Sequence[str] = PAYS_ON) -> str:
    """Tabulates the success of a few searches, by level and energy."""
    found = group_by_search(rows)
    lines = []
    for each in zip(*(found[column] for column in columns), strict=True):
        name, passes, _ = each[0]
        if (name, passes) in PAYING:
            lines.append([name, passes, *(format_rate(of) for _, _, of in each)])
    return make_table(" | ".join(["search", "passes", *columns]), lines)


def group_by_search(rows: Sequence[Row]) -> dict[str, list[tuple[str, str, list[Row]]]]:
    """Groups rows by level and energy: name, passes and rows of each search.

    Every group lists the same searches, also searches without rows.
    """
    found = {}
    for domain, level in dict.fromkeys((row["domain"], row["level"]) for row in rows):
        horizon = find_preset(domain, level, "leap", "leapjax").planner.horizon
        for suffix, setting in MINIMISED.items():
            settings = {
                (search.name, search.cost): setting.searching(**search.of(horizon))
                for search in (*SEARCHES, BEST_OF_MANY)
            }
            # Methods of one action stand beside the learned energy, without rules.
            beside = rows if suffix == LEARNED else []
            ways = select(rows, [level], settings) | select(beside, [level], ONE_ACTION)
            if any(ways.values()):
                found[f"{level}{suffix}"] = [(*way, of) for (_, way), of in ways.items()]
    return found


def group_by_passes(rows: Sequence[Row]) -> dict[str, dict[str, dict[float, Row]]]:
    """Adds up the rows with a learned energy, by level, name of the search and passes."""
    added: dict[str, dict[str, dict[float, Row]]] = {}
    planned = [row for row in rows if row["method"] == "leap"]
    for level, ways in group_by_search(planned).items():
        for name, _, of in ways if level.endswith(LEARNED) else []:
            if of:
                added.setdefault(level, {}).setdefault(name, {}).update(_add_up(of))
    for name, (_, of, _) in group_by_boards(planned):
        if of:
            added.setdefault("Sudoku, 17 to 34 clues, learned", {})[name] = _add_up(of)
    return added


def _add_up(rows: Sequence[Row]) -> dict[float, Row]:
    """Adds up successes and episodes; the key is the mean number of passes of a plan.

    Older rows do not say how many passes a plan took: theirs took as many as there are iterations.
    """
    passes = np.mean([row.get("passes") or row["iterations"] for row in rows])
    sums = {key: sum(row[key] for row in rows) for key in ("successes", "episodes")}
    return {round(float(passes), 1): sums}


def compare_boards(rows: Sequence[Row]) -> str:
    """Tabulates passes and success on boards like those of training, and on boards of a file."""
    lines = [
        [name, *(_average_passes(of) for of in by_boards[1:2]), *map(format_rate, by_boards)]
        for name, by_boards in group_by_boards(rows)
        if any(by_boards)
    ]
    return make_table(
        "search | passes, 17 to 34 clues | 31 to 42 clues | 17 to 34 clues | "
        "17 to 34 clues, with rules",
        lines,
    )


def _average_passes(rows: Sequence[Row]) -> str:
    return f"{np.mean([row['passes'] for row in rows]):.0f}" if rows else "-"


def group_by_boards(rows: Sequence[Row]) -> list[tuple[str, list[list[Row]]]]:
    """Groups rows of `HARD` by search, and by boards: drawn; of a file; of a file, with rules."""
    config = find_preset("sudoku", HARD, "leap", "leapjax")
    settings = list_settings(config, seed=0)

    def read(row: Row, part: str) -> dict[str, Any]:
        """Reads a part of a row's configuration; fields that older rows lack have their default."""
        return dataclasses.asdict(type(getattr(config, part))()) | row["configuration"][part]

    def select_boards(planner: dict[str, Any], boards: str | None, rules: float) -> list[Row]:
        """Returns the rows of a search on some boards, one for each seed."""
        played = {
            "demos": config.demos, "test_seed": config.test_seed, "validation": False,
            "rules": rules, "episodes": MIXTURE_BOARDS if boards else config.episodes,
        }  # fmt: skip
        of = [
            row for row in trained
            if planner == read(row, "planner")
            and row["configuration"]["domain_settings"].get("boards") == boards
            and all(row["configuration"][name] == value for name, value in played.items())
        ]  # fmt: skip
        return list({row["seed"]: row for row in of}.values())

    trained = [
        row for row in rows
        if (row["level"], row["method"]) == (HARD, "leap")
        and all(settings[part] == read(row, part) for part in TRAINED)
    ]  # fmt: skip
    return [
        (
            search.name,
            [
                select_boards(search.of(config.planner.horizon), *of)
                for of in ((None, 0.0), (MIXTURE, 0.0), (MIXTURE, 1.0))
            ],
        )
        for search in SEARCHES
    ]


def compare_arms(rows: Sequence[Row]) -> str:
    """Tabulates success on star graphs with other numbers of arms than in training."""
    lines = [
        [name, *map(format_rate, by_count)]
        for name, by_count in group_by_arms(rows)
        if sum(map(bool, by_count)) > 1
    ]
    return make_table(" | ".join(["planner, passes", *(f"{n} arms" for n in ARMS)]), lines)


def group_by_arms(rows: Sequence[Row]) -> list[tuple[str, list[list[Row]]]]:
    """Groups rows by search and by number of arms in play (`ARMS`); training had three arms."""
    horizon = find_preset("stars", ARMS_LEVEL, "leap", "leapjax").planner.horizon
    levels = [f"Star{count}x{horizon}" for count in ARMS]
    found = []
    for search in SEARCHES:
        settings = {
            level: Setting(
                "leapjax", changes={} if level == ARMS_LEVEL else {"play": level}
            ).searching(**search.of(horizon))
            for level in levels
        }
        of = select(rows, [ARMS_LEVEL], settings).values()
        found.append((f"{search.name}, {search.cost}", list(of)))
    return found
