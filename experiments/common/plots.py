"""Plots of a run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from experiments.common.results import Row
from leapjax import files, scores


def training_curve(metrics: Sequence[dict[str, float]], path: Path) -> None:
    """What the method reports, each against steps: the loss first."""
    steps = [entry["step"] for entry in metrics]
    names = [name for name in metrics[0] if name not in ("step", "seconds")]
    figure, axes = plt.subplots(
        len(names), 1, figsize=(6, 2.2 * len(names)), sharex=True, layout="constrained",
        squeeze=False,
    )  # fmt: skip
    for axis, name in zip(axes[:, 0], names, strict=True):
        values = [entry[name] for entry in metrics]
        axis.plot(steps, values)
        axis.set(ylabel=name.replace("_", " "), yscale="log" if min(values) > 0 else "linear")
    axes[-1, 0].set_xlabel("step")
    _save(figure, path)


def success_by_iteration(
    iterations: Sequence[int], outcomes: Sequence[tuple[int, int]], title: str, path: Path
) -> None:
    """Success rate against planning iterations (paper, figure 6, left).

    Args:
        iterations: after how many iterations plans were executed.
        outcomes: (successes, episodes) for each.
        title: of the plot.
        path: to write.
    """
    rates = [100 * good / count for good, count in outcomes]
    bounds = [scores.wilson_interval(good, count) for good, count in outcomes]
    low = [max(0.0, rate - 100 * b[0]) for rate, b in zip(rates, bounds, strict=True)]
    high = [max(0.0, 100 * b[1] - rate) for rate, b in zip(rates, bounds, strict=True)]
    figure, axis = plt.subplots(figsize=(5, 3.5), layout="constrained")
    axis.errorbar(iterations, rates, yerr=(low, high), marker="o", capsize=3)
    axis.set(xlabel="iterations", ylabel="success (%), 95% interval", title=title)
    axis.set_ylim(0, 101)
    _save(figure, path)


def data_efficiency(rows_by_level: Mapping[str, Mapping[int, Sequence[Row]]], path: Path) -> None:
    """Success against the number of demonstrations, with the paper's from 500 as a line.

    Args:
        rows_by_level: the rows of all seeds, by level and number of demonstrations.
        path: to write.
    """
    figure, axes = plt.subplots(
        1, max(len(rows_by_level), 1), figsize=(9, 3.5), sharey=True, layout="constrained",
        squeeze=False,
    )  # fmt: skip
    for axis, (level, by_demos) in zip(axes[0], rows_by_level.items(), strict=False):
        counts = sorted(by_demos)
        totals = [
            (sum(r["successes"] for r in by_demos[n]), sum(r["episodes"] for r in by_demos[n]))
            for n in counts
        ]
        rates = np.array([100 * good / total for good, total in totals])
        bounds = 100 * np.array([scores.wilson_interval(*total) for total in totals])
        spread = np.maximum([rates - bounds[:, 0], bounds[:, 1] - rates], 0)
        axis.errorbar(counts, rates, yerr=spread, marker="o", capsize=3, label="leapjax")
        for count in counts:
            each = [100 * r["successes"] / r["episodes"] for r in by_demos[count]]
            axis.plot([count] * len(each), each, ".", color="C0", alpha=0.4)
        paper = by_demos[counts[-1]][0]["paper_success"]
        axis.axhline(paper, color="C1", linestyle="--", label=f"paper, 500: {paper:.1f}%")
        axis.set(xlabel="demonstrations", xscale="log", title=level, ylim=(0, 102))
        axis.set_xticks(counts, [str(count) for count in counts], minor=False)
        axis.minorticks_off()
        axis.legend(loc="lower right")
    axes[0][0].set_ylabel("success (%), 95% interval")
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    try:
        with files.whole(path) as scratch:
            figure.savefig(scratch, dpi=120)
    finally:
        plt.close(figure)
