"""The tables of stars and Sudoku, whose plans are executed whole: every way to search."""

import dataclasses
from collections.abc import Sequence

from experiments.common.searches import BEST_OF_MANY, SEARCHES
from experiments.tables.cells import rate, table
from experiments.tables.settings import Setting, of_setting
from leapjax.presets import find_preset
from leapjax.running.results import Row

LEARNED = ", learned"
MINIMISED = {
    LEARNED: Setting("learned", "leapjax"),
    ", rules": Setting("rules", "leapjax", "rules"),
    ", learned and rules": Setting("both", "leapjax", changes={"rules": 1.0}),
}
ONE_ACTION = tuple(Setting(method, "leapjax", method) for method in ("bc", "dt"))
ARMS_LEVEL, ARMS = "Star3x5", (2, 3, 5, 7, 9)  # what was learned, and what it is played on


def uses(row: Row) -> bool:
    """Whether a row is in a table."""
    searched = any(of for each in rows_by_search([row]).values() for _, _, of in each)
    return searched or any(of for _, _, of in rows_by_arms([row]))


def searches(rows: Sequence[Row]) -> str:
    """Success of every way to search with the same trained energy, beside methods of one action."""
    found = rows_by_search(rows)
    lines = []
    for each in zip(*found.values(), strict=True):  # one search, on every level
        name, passes, _ = each[0]
        lines.append([name, passes, *(rate(of) for _, _, of in each)])
    return table(" | ".join(["planner", "passes", *found]), lines)


def rows_by_search(rows: Sequence[Row]) -> dict[str, list[tuple[str, str, list[Row]]]]:
    """By level and what is minimised: name, passes and rows of each way.

    Each has the same ways to search, whether there are rows or not.
    """
    found = {}
    for domain, level in {(row["domain"], row["level"]): None for row in rows}:
        mine = [row for row in rows if (row["domain"], row["level"]) == (domain, level)]
        horizon = find_preset(domain, level, "leap", "leapjax").planner.horizon
        for suffix, setting in MINIMISED.items():
            ways: list[tuple[str, str, list[Row]]] = []
            for search in (*SEARCHES, BEST_OF_MANY):
                of = of_setting(mine, setting, **search.of(horizon))
                ways.append((search.name, search.cost, of))
            for one in ONE_ACTION:
                of = of_setting(mine, one) if suffix == LEARNED else []
                ways.append((f"`--method {one.method}`", "T", of))
            if any(of for _, _, of in ways):
                found[f"{level}{suffix}"] = ways
    return found


def success_by_passes(rows: Sequence[Row]) -> dict[str, dict[str, dict[int, Row]]]:
    """By level, name of the search, and number of passes: rows of what was learned, added up."""
    added: dict[str, dict[str, dict[int, Row]]] = {}
    planned = [row for row in rows if row["method"] == "leap"]
    for level, ways in rows_by_search(planned).items():
        for name, _, of in ways if level.endswith(LEARNED) else []:
            if of:
                sums = {key: sum(row[key] for row in of) for key in ("successes", "episodes")}
                added.setdefault(level, {}).setdefault(name, {})[of[0]["iterations"]] = sums
    return added


def arms(rows: Sequence[Row]) -> str:
    """Success on star graphs of other numbers of arms than were learned."""
    by_search: dict[str, list[list[Row]]] = {}
    for name, _, of in rows_by_arms(rows):
        by_search.setdefault(name, []).append(of)
    lines = [
        [name, *(rate(of) for of in each)]
        for name, each in by_search.items()
        if sum(map(bool, each)) > 1
    ]
    return table(" | ".join(["planner, passes", *(f"{n} arms" for n in ARMS)]), lines)


def rows_by_arms(rows: Sequence[Row]) -> list[tuple[str, int, list[Row]]]:
    """Of what has learned graphs of three arms: the search, arms that it was played on, rows."""
    trained = [row for row in rows if row["level"] == ARMS_LEVEL]
    horizon = find_preset("stars", ARMS_LEVEL, "leap", "leapjax").planner.horizon
    found = []
    for search in SEARCHES:
        for count in ARMS:
            level = f"Star{count}x{horizon}"
            play = {} if level == ARMS_LEVEL else {"play": level}
            setting = dataclasses.replace(MINIMISED[LEARNED], changes=play)
            of = of_setting(trained, setting, **search.of(horizon))
            found.append((f"{search.name}, {search.cost}", count, of))
    return found
