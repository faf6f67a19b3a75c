"""The BabyAI tables: every setting of LEAP, and every method."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.common.results import Row
from experiments.tables.cells import mean_length, mean_rate, outcomes, rate, table, with_interval
from experiments.tables.settings import Setting, of_setting
from leapjax import scores
from leapjax.domains.babyai.levels import LEVELS, paper_success

OURS = Setting("preset `leapjax`", "leapjax")
PAPER = Setting("preset `paper`", "paper")
SETTINGS = (
    Setting("random", "leapjax", "random"),
    PAPER,
    OURS,
    # Chosen on validation levels: docs/tried.md.
    Setting("`leapjax`, `--executed 3`", "leapjax", changes={"executed": 3}),
)
TITLES = " | ".join(setting.title for setting in SETTINGS)
WITHOUT_DISTANCES = Setting(
    "`leapjax`, `--fields 0`", "leapjax", changes={"domain_settings": {"fields": 0}}
)
# The methods of the paper's table, beside the floor, with both presets.
COMPARED = ("random", "bc", "bcq", "iql", "dt", "plate", "mopo", "leap")
BASELINES = tuple(method for method in COMPARED if method not in ("random", "leap"))
# How methods of preset `paper` act, drawn: chosen on validation levels (docs/tried.md). LEAP gains
# nothing by noise.
NOISE: Mapping[str, Mapping[str, Any]] = {
    **{method: {"planner": {"temperature": 4.0}} for method in ("bc", "iql", "dt", "mopo")},
    "plate": {"planner": {"beams": 1, "temperature": 4.0}},
}
BY_METHOD = {
    "preset paper": {method: Setting(method, "paper", method) for method in COMPARED},
    "preset paper, noise": {
        method: Setting(method, "paper", method, noise) for method, noise in NOISE.items()
    },
    "preset leapjax": {method: Setting(method, "leapjax", method) for method in COMPARED},
}
ITERATED = (PAPER, WITHOUT_DISTANCES, OURS)
ITERATIONS = (1, 2, 5, 10, 15, 30)  # T and N of every level, and fewer


def uses(row: Row) -> bool:
    """Whether a row is in a table."""
    if row["level"] not in LEVELS:
        return False
    settings = (*SETTINGS, *(s for each in BY_METHOD.values() for s in each.values()))
    return any(setting.has(row) for setting in settings) or any(
        setting.has(row, iterations=n) for setting in ITERATED for n in ITERATIONS
    )


def success(rows: Sequence[Row]) -> str:
    """Success rates per level: the paper's, and those of every setting; their middle.

    A cell is the mean over seeds, its 95% interval, and the number of seeds.
    """
    papers = [paper_success(level)["leap"] for level in LEVELS]
    lines = [
        [level, f"{paper:.1f}%", *cells]
        for level, paper, cells in zip(LEVELS, papers, _by_setting(rows, rate), strict=True)
    ]
    found = [middle(rows, setting) for setting in SETTINGS]
    cells = ["-" if each is None else with_interval(*each) for each in found]
    lines.append(["interquartile mean", f"{middle_of_paper():.1f}%", *cells])
    return table(f"level | paper | {TITLES}", lines)


def aggregates(rows: Sequence[Row]) -> dict[str, tuple[float, float, float]]:
    """The interquartile means of the paper's LEAP, and of what has rows on every level."""
    paper = middle_of_paper()
    random, *_, executed = SETTINGS
    named = {"random": random}
    for preset, by_method in BY_METHOD.items():
        said = preset.removeprefix("preset ")
        named |= {f"{name}, {said}": of for name, of in by_method.items() if name != "random"}
    named[f"leap, {executed.title}"] = executed
    found = {title: middle(rows, setting) for title, setting in named.items()}
    known = {title: each for title, each in found.items() if each is not None}
    return {"LEAP, the paper's numbers": (paper, paper, paper), **known}


def middle_of_paper() -> float:
    """The interquartile mean of the paper's LEAP, in percent."""
    return float(
        scores.interquartile_mean(np.array([paper_success(level)["leap"] for level in LEVELS]))
    )


def middle(rows: Sequence[Row], setting: Setting) -> tuple[float, float, float] | None:
    """The interquartile mean of a setting over all levels, and its interval, in percent."""
    levels = [
        of_setting([row for row in rows if row["level"] == level], setting) for level in LEVELS
    ]
    if not all(levels):
        return None
    mean, (low, high) = scores.aggregate([outcomes(of) for of in levels])
    return 100 * mean, 100 * low, 100 * high


def steps(rows: Sequence[Row]) -> str:
    """Steps per episode, failed episodes included, of every setting."""
    found = zip(LEVELS, _by_setting(rows, mean_length), strict=True)
    return table(f"level | {TITLES}", [[level, *cells] for level, cells in found])


def _by_setting(rows: Sequence[Row], cell: Callable[[Sequence[Row]], str]) -> list[list[str]]:
    """For each level what `cell` makes of its rows, setting by setting."""
    by_level = {level: [row for row in rows if row["level"] == level] for level in LEVELS}
    return [
        [cell(of_setting(by_level[level], setting)) for setting in SETTINGS] for level in LEVELS
    ]


def iterations(rows: Sequence[Row]) -> str:
    """Success rates against the number of iterations, of training seed 0."""

    def cell(row: Row | None) -> str:
        return f"{mean_rate([row]):.1f}%" if row else ""

    lines = [
        [level, title, *(cell(by_count.get(n)) for n in ITERATIONS)]
        for level, by_title in success_by_iterations(rows).items()
        for title, by_count in by_title.items()
    ]
    return table("level | preset | " + " | ".join(f"N = {n}" for n in ITERATIONS), lines)


def success_by_iterations(rows: Sequence[Row]) -> dict[str, dict[str, dict[int, Row]]]:
    """Rows of training seed 0 by level, title of the setting, and N."""
    found: dict[str, dict[str, dict[int, Row]]] = {}
    for level in LEVELS:
        mine = [row for row in rows if row["level"] == level and row["seed"] == 0]
        for setting in ITERATED:
            counts = {n: of_setting(mine, setting, iterations=n) for n in ITERATIONS}
            by_count = {n: played[0] for n, played in counts.items() if played}
            if len(by_count) > 1:  # one alone says nothing of iterating
                found.setdefault(level, {})[setting.title] = by_count
    return found


def methods(rows: Sequence[Row]) -> str:
    """Success rates of every method: the paper's, and those of both presets; the best in bold."""
    lines = []
    for level, by_preset in rows_by_method(rows).items():
        theirs = paper_success(level)
        cells = {name: f"{percent:.1f}%" for name, percent in theirs.items()}
        lines.append([level, "the paper", *_compared(theirs, cells)])
        for preset, by_method in by_preset.items():
            if not by_method:
                continue
            ours = {name: mean_rate(of) for name, of in by_method.items()}
            cells = {name: rate(of) for name, of in by_method.items()}
            lines.append([level, preset, *_compared(ours, cells)])
    return table("level | | " + " | ".join(COMPARED), lines)


def _compared(rates: Mapping[str, float], cells: Mapping[str, str]) -> list[str]:
    """The cell of every method, those of the best rate in bold."""
    best = max(rates.values(), default=None)
    bold = {name: f"**{cell}**" for name, cell in cells.items() if rates[name] == best}
    return [{**cells, **bold}.get(name, "-") for name in COMPARED]


def rows_by_method(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, list[Row]]]]:
    """Rows by level, preset and method, of levels where there are some of a baseline."""
    found = {}
    for level in LEVELS:
        mine = [row for row in rows if row["level"] == level]
        by_preset = {
            preset: {
                method: of
                for method, setting in settings.items()
                if (of := of_setting(mine, setting))
            }
            for preset, settings in BY_METHOD.items()
        }
        if any(name in by_method for by_method in by_preset.values() for name in BASELINES):
            found[level] = by_preset
    return found


def success_by_method(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Success in percent by level, whose numbers they are, and method."""
    return {
        level: {
            "the paper": paper_success(level),
            **{
                preset: {name: mean_rate(of) for name, of in by_method.items()}
                for preset, by_method in by_preset.items()
            },
        }
        for level, by_preset in rows_by_method(rows).items()
    }


def acting(rows: Sequence[Row]) -> str:
    """Steps of an episode, and plans where they are fewer, with preset `leapjax`, seed 0."""

    def cell(row: Row) -> str:
        steps, plans = row["mean_length"], row["plans"] / row["episodes"]
        return f"{steps:.1f}" if round(steps - plans, 1) == 0 else f"{steps:.1f} ({plans:.1f})"

    return _by_acting_method(rows, cell)


def price(rows: Sequence[Row], measured: Sequence[Row]) -> str:
    """Milliseconds of planning for each action, with preset `leapjax`.

    Args:
        rows: of episodes, for the plans that an action takes (seed 0).
        measured: plans per second, those of `benchmarks.methods`.
    """
    speeds = {(row["level"], row["method"]): row["plans_per_second"] for row in measured}

    def cell(row: Row) -> str:
        plans = row["plans"] / (row["mean_length"] * row["episodes"])
        return f"{1e3 * plans / speeds[row['level'], row['method']]:.3f}"

    return _by_acting_method([r for r in rows if (r["level"], r["method"]) in speeds], cell)


def _by_acting_method(rows: Sequence[Row], cell: Callable[[Row], str]) -> str:
    """A line for each level, a cell for each method: of preset `leapjax` and training seed 0."""
    methods = [name for name in COMPARED if name != "random"]
    lines = []
    for level, by_preset in rows_by_method(rows).items():
        first = {
            name: cell(row)
            for name, every in by_preset["preset leapjax"].items()
            for row in every
            if row["seed"] == 0
        }
        lines.append([level, *(first.get(name, "-") for name in methods)])
    return table("level | " + " | ".join(methods), lines)
