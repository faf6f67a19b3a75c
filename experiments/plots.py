"""Plots of a run."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from leapjax import scores


def loss(metrics: Sequence[dict[str, float]], path: Path) -> None:
    """Training loss and accuracy against steps."""
    steps = [entry["step"] for entry in metrics]
    figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
    axis.plot(steps, [entry["loss"] for entry in metrics], color="C0")
    axis.set(xlabel="step", ylabel="masked cross-entropy (nats)", yscale="log")
    right = axis.twinx()
    right.plot(steps, [100 * entry["accuracy"] for entry in metrics], color="C1")
    right.set_ylabel("accuracy of masked actions (%)", color="C1")
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


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=120)
    plt.close(figure)
