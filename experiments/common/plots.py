"""Plots of a run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from experiments.common.results import Row
from leapjax import files, scores
from leapjax.errors import UserError


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
    save(figure, path)


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
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set(xlabel="iterations", ylabel="success (%), 95% interval", title=title)
    axis.set_ylim(0, 101)
    save(figure, path)


def iterations_by_level(rows: Mapping[str, Mapping[str, Mapping[int, Row]]], path: Path) -> None:
    """Success rate against planning iterations, a panel for each level.

    Args:
        rows: by level, label of the line, and number of iterations.
        path: to write.
    """
    figure, axes = _panels(len(rows), columns=4, width=2.7 if len(rows) > 1 else 5)
    labels = list(dict.fromkeys(label for by_label in rows.values() for label in by_label))
    drawn: dict[str, Line2D] = {}  # one of each label, for the legend
    for axis, (level, by_label) in zip(axes, rows.items(), strict=False):
        for label, by_count in by_label.items():
            rates = [100 * row["successes"] / row["episodes"] for row in by_count.values()]
            index = labels.index(label)
            (drawn[label],) = axis.plot(
                list(by_count), rates, "o-", color=f"C{index}",
                markersize=max(4.5, 10 - 0.7 * index),  # so that none hides another
            )  # fmt: skip
        axis.set_title(level, fontsize=9)
        axis.set(xscale="log", ylim=(0, 102), xlabel="passes N")
        ticks = sorted({count for by_count in by_label.values() for count in by_count})
        axis.set_xticks(ticks, [str(count) for count in ticks])
        axis.minorticks_off()
    columns = max(1, min(len(rows), 4, len(labels)))
    figure.set_figheight(figure.get_figheight() + 0.2 * len(labels) / columns)
    figure.legend(
        [drawn[label] for label in labels], [label.replace("`", "") for label in labels],
        loc="outside lower center", fontsize=8, ncols=columns,
    )  # fmt: skip
    save(figure, path)


def methods_by_level(
    rates: Mapping[str, Mapping[str, Mapping[str, float]]], names: Sequence[str], path: Path
) -> None:
    """Success rates as bars, a panel for each level (paper, figure 'Quantitative Results').

    Args:
        rates: in percent by level, whose numbers they are (the same everywhere), and method.
        names: of all methods, in order.
        path: to write.
    """
    figure, axes = _panels(len(rates), columns=3, width=4.5)
    for axis, (level, by_whom) in zip(axes, rates.items(), strict=False):
        width = 0.8 / len(by_whom)
        for index, (whose, by_method) in enumerate(by_whom.items()):
            places = [names.index(name) + width * (index + 0.5) - 0.4 for name in by_method]
            axis.bar(places, list(by_method.values()), width, label=whose, color=f"C{index}")
        axis.set_xticks(range(len(names)), names, rotation=30)
        axis.set(ylim=(0, 102))
        axis.set_title(level, fontsize=9)
    if rates:
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    save(figure, path)


def intervals(found: dict[str, tuple[float, float, float]], path: Path) -> None:
    """Aggregate scores with their intervals, one below the other (Agarwal et al., 2021).

    Args:
        found: by label: in percent the score, and the bounds of its interval.
        path: to write.
    """
    figure, axis = plt.subplots(figsize=(6, 0.8 + 0.35 * len(found)), layout="constrained")
    for place, (score, low, high) in enumerate(reversed(found.values())):
        axis.barh(place, high - low, left=low, height=0.5, color="C0", alpha=0.6)
        axis.plot([score, score], [place - 0.3, place + 0.3], color="black")
    axis.set_yticks(range(len(found)), [label.replace("`", "") for label in reversed(found)])
    axis.set(xlim=(0, 102))
    axis.set_xlabel("interquartile mean of success (%), and its 95% interval", fontsize=9)
    axis.grid(axis="x", alpha=0.3)
    save(figure, path)


def landscape(found: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Energies of good and bad plans over training, and of plans over iterations.

    Args:
        found: of each preset, as `experiments.landscape` has it.
        path: to write.
    """
    figure, axes = plt.subplots(
        len(found), 2, figsize=(9, 3 * len(found)), layout="constrained", squeeze=False
    )
    for (left, right), each in zip(axes, found, strict=True):
        names = [name for name in each["training"][0] if name != "step"]
        steps = [entry["step"] for entry in each["training"]]
        for index, name in enumerate(names):
            share = name.removeprefix("random_")
            colour = plt.get_cmap("viridis")(index / max(1, len(names) - 1))
            values = [entry[name] for entry in each["training"]]
            left.plot(steps, values, color=colour, label=f"{share}% random")
        left.set(xlabel="training step", ylabel="energy", yscale="log")
        left.set_title(f"{each['level']}, preset {each['preset']}", fontsize=9)
        left.legend(fontsize=7)
        passes = range(1, len(each["planning"]["mean"]) + 1)
        for index, single in enumerate(each["planning"]["single"]):
            label = "single plans" if index == 0 else None
            right.plot(passes, single, color="0.7", linewidth=1, label=label)
        right.plot(passes, each["planning"]["mean"], "o-", label="mean of all plans")
        right.set(xlabel="passes N", ylabel="energy", yscale="log")
        right.set_title("of plans being refined", fontsize=9)
        right.legend(fontsize=7)
    save(figure, path)


def energy_against_reward(found: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """The mean energy of each trajectory against its return, both from 0 to 1.

    Args:
        found: by game, as `experiments.atari_energy` has it.
        path: to write.
    """
    figure, axes = plt.subplots(
        1, len(found), figsize=(3 * len(found), 2.8), layout="constrained", squeeze=False
    )

    def scaled(values: Sequence[float]) -> np.ndarray:
        least, most = min(values), max(values)
        return (np.array(values) - least) / max(most - least, 1e-9)

    for axis, (name, each) in zip(axes[0], found.items(), strict=True):
        axis.scatter(scaled(each["returns"]), scaled(each["energies"]), s=14, alpha=0.7)
        axis.set(xlabel="reward", xlim=(-0.05, 1.05), ylim=(-0.05, 1.05))
        axis.set_title(f"{name}: rank correlation {each['correlation']:.2f}", fontsize=9)
    axes[0][0].set_ylabel("energy")
    save(figure, path)


def _panels(count: int, columns: int, width: float) -> tuple[Figure, Sequence[Axes]]:
    """A figure of so many panels of success, at most `columns` side by side, one for each level."""
    columns = min(columns, max(1, count))
    lines = max(1, -(-count // columns))
    figure, axes = plt.subplots(
        lines, columns, figsize=(width * columns, 2.6 * lines), sharey=True, layout="constrained",
        squeeze=False,
    )  # fmt: skip
    for axis in axes.flat[count:]:
        axis.set_axis_off()
    for axis in axes[:, 0]:
        axis.set_ylabel("success (%)")
    return figure, list(axes.flat)


def check_figure(path: Path) -> None:
    """Refuses, before anything is measured, a file that no figure can be written to.

    Raises:
        UserError: it is of another kind, or its folder cannot be written to.
    """
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix.removeprefix(".").lower() not in known:
        raise UserError(f"{path}: a figure can be {', '.join(sorted(known))}")
    files.check_writable(path.parent)


def save(figure: Figure, path: Path) -> None:
    """Writes a figure, atomically, and lets go of it."""
    try:
        with files.whole(path) as scratch:
            figure.savefig(scratch, dpi=120)
    finally:
        plt.close(figure)
