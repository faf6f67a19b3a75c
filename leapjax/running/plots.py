"""Plots of a run."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from leapjax import files, scores
from leapjax.errors import UserError


def draw_training_curve(metrics: Sequence[dict[str, float]], path: Path) -> None:
    """Plots each reported value against training steps, the loss first."""
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
    save(figure, path)


def draw_success_by_iteration(
    iterations: Sequence[int], outcomes: Sequence[tuple[int, int]], title: str, path: Path
) -> None:
    """Plots success against planning iterations (paper, figure 6, left).

    Args:
        iterations: numbers of iterations after which plans were executed.
        outcomes: (successes, episodes) for each number of iterations.
        title: title of the plot.
        path: file to write.
    """
    rates = [100 * good / count for good, count in outcomes]
    bounds = [scores.wilson_interval(good, count) for good, count in outcomes]
    low = [max(0.0, rate - 100 * b[0]) for rate, b in zip(rates, bounds, strict=True)]
    high = [max(0.0, 100 * b[1] - rate) for rate, b in zip(rates, bounds, strict=True)]
    figure, axis = plt.subplots(figsize=(5, 3.5), layout="constrained")
    axis.errorbar(iterations, rates, yerr=(low, high), marker="o", capsize=3)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set(xlabel="iterations", ylabel="success (%), 95% interval", title=title)
    axis.set_ylim(0, 101)
    save(figure, path)


def check_figure(path: Path) -> None:
    """Checks, before any measurement, that a figure can be written.

    Raises:
        UserError: the file type is unknown, or the folder cannot be written to.
    """
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix.removeprefix(".").lower() not in known:
        raise UserError(f"{path}: a figure can be {', '.join(sorted(known))}")
    files.check_writable(path.parent)


def save(figure: Figure, path: Path) -> None:
    """Writes a figure atomically and closes it."""
    try:
        with files.write_whole(path) as scratch:
            figure.savefig(scratch, dpi=120)
    finally:
        plt.close(figure)
