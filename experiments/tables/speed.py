"""The tables of measurements: plans and training steps per second, and what searches cost."""

from collections.abc import Sequence

from experiments.tables.cells import table
from leapjax.running.results import Row


def speed(rows: Sequence[Row]) -> str:
    """Plans per second at batch 256 and alone."""
    lines = []
    for row in rows:
        if row["batch"] != 256:
            continue
        same = ("preset", "horizon", "iterations")
        alone = [r for r in rows if r["batch"] == 1 and all(r[key] == row[key] for key in same)]
        lines.append(
            [
                f"T = {row['horizon']}, N = {row['iterations']}",
                f"`{row['preset']}`",
                f"{row['plans_per_second']:,.0f}",
                f"{row['fraction_of_peak']:.0%}",
                f"{1e3 * alone[0]['seconds']:.1f} ms" if alone else "-",
            ]
        )
    header = "plan | preset | plans per second | of the matrix-multiply peak | one alone"
    return table(header, lines)


def planning(rows: Sequence[Row]) -> str:
    """Every measurement of planning."""
    lines = [
        [
            f"`{row['preset']}`",
            f"{row['horizon']}, {row['iterations']}",
            str(row["batch"]),
            f"{row['plans_per_second']:,.0f}",
            f"{row['gflops']:.0f}",
            f"{row['peak_gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
        ]
        for row in rows
        if row["batch"] in (1, 16, 256, 1024)
    ]
    return table("preset | T, N | batch | plans/s | GFLOP/s | peak | fraction", lines)


def quality(rows: Sequence[Row]) -> str:
    """What each way to search gives and costs, for each planner: success, steps, ms per plan."""

    def cell(row: Row) -> str:
        rate, milliseconds = row["successes"] / row["episodes"], 1e3 / row["plans_per_second"]
        return f"{rate:.1%}, {row['mean_length']:.1f}, {milliseconds:.2f}"

    planners = list(dict.fromkeys((row["level"], row["preset"]) for row in rows))
    found = {(row["level"], row["preset"], row["variant"]): cell(row) for row in rows}
    titles = [f"{level}, `{preset}`" for level, preset in planners]
    lines = [
        [variant, *(found.get((*planner, variant), "-") for planner in planners)]
        for variant in dict.fromkeys(row["variant"] for row in rows)
    ]
    return table(" | ".join(["search", *titles]), lines)


def training(rows: Sequence[Row]) -> str:
    """Every measurement of training."""
    lines = [
        [
            row["level"],
            f"`{row['preset']}`" + (f", `--run {row['run']}`" if row["run"] > 1 else ""),
            f"{1e3 / row['steps_per_second']:.0f}",
            f"{row['flops_per_step'] / 1e9:.1f}",
            f"{row['gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
            f"{row['training_seconds']:,.0f} s for {row['steps']:,} steps",
        ]
        for row in rows
    ]
    header = "level | preset | ms/step | GFLOP/step | GFLOP/s | of the peak | a run"
    return table(header, lines)


def parts(rows: Sequence[Row]) -> str:
    """Where the time of a step goes, of every measurement of training."""
    lines = []
    for row in rows:
        step = 1e3 / row["steps_per_second"]
        found = [f"{part['ms']:.1f}" for part in row["parts"]]
        rates = [
            f" ({part['gflop'] / part['ms'] * 1e3:.0f})" if part["gflop"] else ""
            for part in row["parts"]
        ]
        cells = [ms + rate for ms, rate in zip(found, rates, strict=True)]
        lines.append([row["level"], f"`{row['preset']}`", f"{step:.1f}", *cells])
    names = [part["part"] for part in rows[0]["parts"]] if rows else []
    return table(" | ".join(["level", "preset", "step", *names]), lines)
