"""The BabyAI tables: every setting of LEAP, and every method."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.noise import make_noise
from experiments.paper import list_success
from experiments.tables.cells import (
    collect_outcomes,
    compute_interval,
    compute_mean_rate,
    format_beside,
    format_rate,
    format_with_interval,
    make_table,
)
from experiments.tables.settings import Setting, select
from leapjax import scores
from leapjax.domains.babyai.levels import HELD_OUT, LEVELS, MIXTURES, find_level, list_played
from leapjax.methods import find_method
from leapjax.running.results import Row

PAPER, OURS = Setting("paper"), Setting("leapjax")
PRESETS = {"preset `paper`": PAPER, "preset `leapjax`": OURS}
BESIDE_CLONING = {
    "LEAP, preset `paper`": PAPER,
    "cloning, preset `paper`": Setting("paper", "bc"),
    "LEAP, preset `leapjax`": OURS,
    "cloning, preset `leapjax`": Setting("leapjax", "bc"),
}
SETTINGS = {
    "random": Setting("leapjax", "random"),
    **PRESETS,
    # Chosen on validation levels: docs/lessons.md.
    "`leapjax`, `--executed 3`": Setting("leapjax", changes={"executed": 3}),
}
# The paper's methods, and random actions as the floor.
COMPARED = ("random", "bc", "bcq", "iql", "dt", "plate", "mopo", "leap")
BASELINES = tuple(method for method in COMPARED if method not in ("random", "leap"))
# Noise for methods with preset `paper`, chosen on validation levels (`experiments.tables.noise`).
# It does not help BCQ and LEAP.
NOISE = {
    method: make_noise(4.0, find_method(method).planner)
    for method in ("bc", "iql", "dt", "mopo", "plate")
}
NOISY = "preset `paper`, noise"
BY_METHOD = {
    "preset `paper`": {method: Setting("paper", method) for method in COMPARED},
    NOISY: {method: Setting("paper", method).searching(**noise) for method, noise in NOISE.items()},
    "preset `leapjax`": {method: Setting("leapjax", method) for method in COMPARED},
}
ITERATIONS = (1, 2, 5, 10, 15, 30)  # includes T and N of every level
ITERATED = {
    "preset `paper`": PAPER,
    "`leapjax`, `--fields 0`": Setting("leapjax", changes={"domain_settings": {"fields": 0}}),
    "preset `leapjax`": OURS,
}
BY_ITERATIONS = {
    (title, n): setting.searching(iterations=n)
    for title, setting in ITERATED.items()
    for n in ITERATIONS
}
# The planner of all levels on a single level, by level.
EVERY = {
    name: Setting("leapjax", changes={"play": name}) for name in list_played(find_level("BabyAI"))
}
USED = (
    *SETTINGS.values(),
    *BY_ITERATIONS.values(),
    *(setting for by_method in BY_METHOD.values() for setting in by_method.values()),
)


def is_used(row: Row) -> bool:
    """Tells whether a row is in a table or a figure."""
    if row["level"] in MIXTURES:
        return EVERY.get(row["played"], OURS).has(row)  # a single level, or all levels
    return row["level"] in LEVELS and any(setting.has(row) for setting in USED)


def compare_settings(rows: Sequence[Row], settings: Mapping[str, Setting]) -> str:
    """Tabulates the success of the paper's LEAP and of some settings, by level.

    A cell holds the mean over seeds, its 95% interval, and the number of seeds. The last line is
    the interquartile mean.

    Args:
        rows: rows of BabyAI.
        settings: settings by title, a column for each.
    """
    found = select(rows, LEVELS, settings)
    lines = [
        [
            level,
            f"{list_success(level)['leap']:.1f}%",
            *(format_rate(found[level, title]) for title in settings),
        ]
        for level in LEVELS
    ]
    middles = [compute_middle(rows, setting) for setting in settings.values()]
    cells = ["-" if each is None else format_with_interval(*each) for each in middles]
    lines.append(["interquartile mean", f"{compute_paper_middle():.1f}%", *cells])
    return make_table(" | ".join(["level", "published", *settings]), lines)


def list_levels(rows: Sequence[Row], demonstrated: Mapping[str, Mapping[str, Any]]) -> str:
    """Tabulates success and steps of the planner of all levels, beside the demonstrating bot's.

    Levels that were never learned come first, then those that fail most.

    Args:
        rows: rows of BabyAI.
        demonstrated: results of `experiments.demonstrator` by level.
    """
    found = {name: of for (_, name), of in select(rows, ["BabyAI"], EVERY).items() if of}

    def order(name: str) -> tuple[bool, float]:
        return name not in HELD_OUT, compute_mean_rate(found[name])

    lines = []
    for name in sorted(found, key=order):
        solved = [row for row in found[name] if row["successes"]]
        steps = sum(row["successes"] * row["mean_success_length"] for row in solved)
        bot, short = demonstrated[name], name.removeprefix("BabyAI-").removesuffix("-v0")
        lines.append([
            f"{short} (not learned)" if name in HELD_OUT else short,
            format_with_interval(compute_mean_rate(found[name]), *compute_interval(found[name])),
            f"{steps / sum(row['successes'] for row in solved):.1f}" if solved else "-",
            f"{bot['successes'] / bot['episodes']:.1%}",
            f"{bot['mean_success_length']:.1f}" if bot["successes"] else "-",
        ])  # fmt: skip
    return make_table("level | success | steps | the bot's success | the bot's steps", lines)


def compute_aggregates(rows: Sequence[Row]) -> dict[str, tuple[float, float, float]]:
    """Computes interquartile means with intervals, in percent, by title.

    Includes the paper's LEAP, and each setting that has rows on every level.
    """
    paper = compute_paper_middle()
    executed = "`leapjax`, `--executed 3`"
    named = {"random": SETTINGS["random"]} | {
        f"{method}, {preset}": setting
        for preset, by_method in BY_METHOD.items()
        for method, setting in by_method.items()
        if method != "random"
    }
    named["leap, preset `leapjax`, 3 executed"] = SETTINGS[executed]
    found = {title: compute_middle(rows, setting) for title, setting in named.items()}
    known = {title: each for title, each in found.items() if each is not None}
    return {"LEAP, published": (paper, paper, paper), **known}


def compute_paper_middle() -> float:
    """Computes the interquartile mean of the paper's LEAP, in percent."""
    papers = np.array([list_success(level)["leap"] for level in LEVELS])
    return float(scores.interquartile_mean(papers))


def compute_middle(rows: Sequence[Row], setting: Setting) -> tuple[float, float, float] | None:
    """Computes a setting's interquartile mean over all levels and its interval, in percent.

    Returns `None` if a level has no rows.
    """
    levels = select(rows, LEVELS, {"": setting}).values()
    if not all(levels):
        return None
    mean, (low, high) = scores.aggregate([collect_outcomes(of) for of in levels])
    return 100 * mean, 100 * low, 100 * high


def compare_iterations(rows: Sequence[Row]) -> str:
    """Tabulates success and mean steps of episodes against N, for training seed 0."""

    def cell(row: Row) -> str:
        return f"{compute_mean_rate([row]):.1f}%, {row['mean_length']:.1f}"

    lines = [
        [level, title, *(cell(of[n]) if n in of else "" for n in ITERATIONS)]
        for level, by_title in group_by_iterations(rows).items()
        for title, of in by_title.items()
    ]
    return make_table("level | preset | " + " | ".join(f"N = {n}" for n in ITERATIONS), lines)


def group_by_iterations(rows: Sequence[Row]) -> dict[str, dict[str, dict[float, Row]]]:
    """Groups the rows of training seed 0 by level, title of the setting, and N.

    Prefers rows of a checkpoint played again, because these have one network.
    """
    first = [row for row in rows if row["seed"] == 0]
    trained = select(first, LEVELS, BY_ITERATIONS)
    again = select([row for row in first if not row["train_steps"]], LEVELS, BY_ITERATIONS)
    found: dict[str, dict[str, dict[float, Row]]] = {}
    for level in LEVELS:
        for title in ITERATED:
            by_count: dict[float, Row] = {
                n: of[0]
                for n in ITERATIONS
                if (of := again[level, (title, n)] or trained[level, (title, n)])
            }
            if len(by_count) > 1:  # a single N does not show the effect of iterations
                found.setdefault(level, {})[title] = by_count
    return found


def compare_methods(rows: Sequence[Row]) -> str:
    """Tabulates success rates of every method, published and with both presets.

    Bold cells are the best of a preset, with or without noise, and cells whose intervals overlap
    the best's interval.
    """
    lines = []
    for level, by_preset in group_by_method(rows).items():
        best = {preset: _find_best(by_method.values()) for preset, by_method in by_preset.items()}
        best["preset `paper`"] = best[NOISY] = _find_best([best["preset `paper`"], best[NOISY]])
        for method in COMPARED:
            published = list_success(level).get(method)
            cells = ["-" if published is None else f"{published:.1f}%"]
            for preset, by_method in by_preset.items():
                of = by_method.get(method, [])
                cell = format_beside(of, published if preset == "preset `paper`" else None)
                cells.append(f"**{cell}**" if of and _overlap(of, best[preset]) else cell)
            lines.append([level, method, *cells])
    return make_table(" | ".join(["level", "method", "published", *BY_METHOD]), lines)


def _find_best(groups: Iterable[list[Row]]) -> list[Row]:
    """Returns the group of rows with the highest mean success; [] if all are empty."""
    return max(filter(None, groups), key=compute_mean_rate, default=[])


def _overlap(rows: Sequence[Row], others: Sequence[Row]) -> bool:
    """Tells whether the intervals of two groups of rows overlap."""
    (low, high), (other_low, other_high) = compute_interval(rows), compute_interval(others)
    return low <= other_high and other_low <= high


def group_by_method(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, list[Row]]]]:
    """Groups rows by level, preset and method, for levels with rows of a baseline."""
    found: dict[str, dict[str, dict[str, list[Row]]]] = {}
    for level in LEVELS:
        by_preset = {
            preset: {m: of for (_, m), of in select(rows, [level], settings).items() if of}
            for preset, settings in BY_METHOD.items()
        }
        if any(name in by_method for by_method in by_preset.values() for name in BASELINES):
            found[level] = by_preset
    return found


def compute_success_by_method(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Computes success in percent by level, source (published or a preset) and method."""
    return {
        level: {"published": list_success(level)}
        | {
            preset: {name: compute_mean_rate(of) for name, of in by_method.items()}
            for preset, by_method in by_preset.items()
        }
        for level, by_preset in group_by_method(rows).items()
    }


def compare_prices(rows: Sequence[Row], measured: Sequence[Row]) -> str:
    """Tabulates the milliseconds of planning for each action, with preset `leapjax`.

    Args:
        rows: rows of BabyAI; training seed 0 gives the number of plans for each action.
        measured: measurements of `benchmarks.methods`, in plans per second.
    """
    speeds = {(row["level"], row["method"]): row["plans_per_second"] for row in measured}

    def cell(row: Row) -> str:
        plans = row["plans"] / (row["mean_length"] * row["episodes"])
        return f"{1e3 * plans / speeds[row['level'], row['method']]:.3f}"

    known = [row for row in rows if row["seed"] == 0 and (row["level"], row["method"]) in speeds]
    methods = [name for name in COMPARED if name != "random"]
    lines = []
    for level, by_preset in group_by_method(known).items():
        first = {name: cell(row) for name, (row,) in by_preset["preset `leapjax`"].items()}
        lines.append([level, *(first.get(name, "-") for name in methods)])
    return make_table("level | " + " | ".join(methods), lines)
