"""The tables of measurements: plans and training steps per second, and the time of searches."""

from collections.abc import Sequence

from experiments.tables.cells import Columns, list_rows, make_table
from leapjax.running.results import Row


def compare_speed(rows: Sequence[Row]) -> str:
    """Tabulates plans per second at batch 256, and the time of a single plan."""

    def plan(row: Row) -> tuple:
        return row["preset"], row["horizon"], row["iterations"]

    alone = {plan(row): f"{1e3 * row['seconds']:.1f} ms" for row in rows if row["batch"] == 1}
    columns: Columns = {
        "plan": "T = {horizon}, N = {iterations}",
        "preset": "`{preset}`",
        "plans per second": "{plans_per_second:,.0f}",
        "of the matrix-multiply peak": "{fraction_of_peak:.0%}",
        "one alone": lambda row: alone.get(plan(row), "-"),
    }
    return list_rows([row for row in rows if row["batch"] == 256], columns)


def list_planning(rows: Sequence[Row]) -> str:
    """Tabulates the measurements of planning."""
    columns: Columns = {
        "preset": "`{preset}`", "T, N": "{horizon}, {iterations}", "batch": "{batch}",
        "plans/s": "{plans_per_second:,.0f}", "GFLOP/s": "{gflops:.0f}",
        "peak": "{peak_gflops:.0f}", "fraction": "{fraction_of_peak:.0%}",
    }  # fmt: skip
    return list_rows([row for row in rows if row["batch"] in (1, 16, 256, 1024)], columns)


def compare_quality(rows: Sequence[Row]) -> str:
    """Tabulates success, steps and milliseconds per plan of each search, for each planner."""

    def cell(row: Row) -> str:
        rate, milliseconds = row["successes"] / row["episodes"], 1e3 / row["plans_per_second"]
        return f"{rate:.1%}, {row['mean_length']:.1f}, {milliseconds:.2f}"

    found = {(row["variant"], f"{row['level']}, `{row['preset']}`"): cell(row) for row in rows}
    variants, planners = (dict.fromkeys(key[i] for key in found) for i in (0, 1))
    lines = [[name, *(found.get((name, of), "-") for of in planners)] for name in variants]
    return make_table(" | ".join(["search", *planners]), lines)


def list_training(rows: Sequence[Row]) -> str:
    """Tabulates the measurements of training."""
    columns: Columns = {
        "level": "{level}",
        "preset": lambda row: (
            f"`{row['preset']}`"
            + (f", `--consecutive {row['consecutive']}`" if row["consecutive"] > 1 else "")
        ),
        "ms/step": lambda row: f"{1e3 / row['steps_per_second']:.0f}",
        "GFLOP/step": lambda row: f"{row['flops_per_step'] / 1e9:.1f}",
        "GFLOP/s": "{gflops:.0f}",
        "of the peak": "{fraction_of_peak:.0%}",
        "a run": "{training_seconds:,.0f} s for {steps:,} steps",
    }
    return list_rows(rows, columns)


def list_parts(rows: Sequence[Row]) -> str:
    """Tabulates the parts of a training step in milliseconds, with their GFLOP/s."""

    def cell(part: Row) -> str:
        rate = f" ({part['gflop'] / part['ms'] * 1e3:.0f})" if part["gflop"] else ""
        return f"{part['ms']:.1f}{rate}"

    lines = [
        [row["level"], f"`{row['preset']}`", f"{1e3 / row['steps_per_second']:.1f}",
         *map(cell, row["parts"])]
        for row in rows
    ]  # fmt: skip
    names = [part["part"] for part in rows[0]["parts"]] if rows else []
    return make_table(" | ".join(["level", "preset", "step", *names]), lines)
