"""Parts of tables: rates with their intervals, means, Markdown."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from leapjax import scores
from leapjax.running.results import Row

Columns = Mapping[str, str | Callable[[Row], str]]


def format_rate(rows: Sequence[Row]) -> str:
    """Formats the mean success of rows, one for each seed, with its interval and their number.

    Two seeds tell little about the spread of seeds, so their cell has both rates, without an
    interval.
    """
    if not rows:
        return "-"
    mean = compute_mean_rate(rows)
    if len(rows) == 2:
        low, high = sorted(compute_mean_rate([row]) for row in rows)
        return f"{mean:.1f}% ({low:.1f}, {high:.1f}), 2 seeds"
    said = format_with_interval(mean, *compute_interval(rows))
    if rows[0]["method"] == "rules":  # has no training seeds
        return said
    return f"{said}, {len(rows)} seed{'s' if len(rows) > 1 else ''}"


def format_beside(rows: Sequence[Row], published: float | None) -> str:
    """Formats a rate as `format_rate`; marks an interval above or below the published number."""
    cell = format_rate(rows)
    if not rows or published is None:
        return cell
    low, high = compute_interval(rows)
    return cell + " ↑" * (low > published) + " ↓" * (high < published)


def compute_interval(rows: Sequence[Row]) -> tuple[float, float]:
    """Computes the 95% interval of the success of rows, one for each seed, in percent."""
    _, (low, high) = scores.aggregate([collect_outcomes(rows)])
    return 100 * low, 100 * high


def collect_outcomes(rows: Sequence[Row]) -> scores.Outcomes:
    """Returns the outcomes of rows, one for each seed.

    Returns every episode's outcome if all rows have episodes recorded on equal levels, and the
    counts of successes and episodes otherwise.
    """
    recorded = [row["recorded"] for row in rows if row.get("recorded") is not None]
    levels = {each["seed"].tobytes() for each in recorded}
    if len(recorded) == len(rows) and len(levels) == 1:
        return np.stack([each["success"] for each in recorded])
    return [row["successes"] for row in rows], [row["episodes"] for row in rows]


def format_with_interval(mean: float, low: float, high: float) -> str:
    """Formats a mean and its interval, in percent."""
    return f"{mean:.1f}% [{low:.1f}, {high:.1f}]"


def compute_mean_rate(rows: Sequence[Row]) -> float:
    """Computes the mean success of rows, in percent."""
    return 100 * sum(row["successes"] for row in rows) / sum(row["episodes"] for row in rows)


def list_rows(rows: Sequence[Row], columns: Columns) -> str:
    """Makes a Markdown table with a line for each row.

    Args:
        rows: rows, in order.
        columns: cells by title: a format string of the row's fields, or a function of the row.
    """
    lines = [
        [cell.format(**row) if isinstance(cell, str) else cell(row) for cell in columns.values()]
        for row in rows
    ]
    return make_table(" | ".join(columns), lines)


def make_table(header: str, lines: Sequence[Sequence[str]]) -> str:
    """Makes a Markdown table; bars separate the titles in `header`."""
    columns = header.count("|") + 1
    rows = [f"| {header} |", "| " + " | ".join(["---"] * columns) + " |"]
    return "\n".join([*rows, *(f"| {' | '.join(cells)} |" for cells in lines)])
