"""The figures of the documents, from rows and measurements."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from leapjax.running import plots
from leapjax.running.results import Row


def draw_iterations(rows: Mapping[str, Mapping[str, Mapping[float, Row]]], path: Path) -> None:
    """Draws success rates against planning passes, a panel for each level.

    Args:
        rows: rows by level, label of the line, and number of iterations.
        path: file to write.
    """
    figure, axes = _make_panels(len(rows), columns=4, width=2.7 if len(rows) > 1 else 5)
    labels = list(dict.fromkeys(label for by_label in rows.values() for label in by_label))
    drawn: dict[str, Line2D] = {}  # a line for each label, for the legend
    for axis, (level, by_label) in zip(axes, rows.items(), strict=False):
        for label, by_count in by_label.items():
            rates = [100 * row["successes"] / row["episodes"] for row in by_count.values()]
            index = labels.index(label)
            (drawn[label],) = axis.plot(
                list(by_count), rates, "o-", color=f"C{index}",
                markersize=max(4.5, 10 - 0.7 * index),  # later lines do not hide earlier ones
            )  # fmt: skip
        axis.set_title(level, fontsize=9)
        axis.set(xscale="log", ylim=(0, 102), xlabel="passes N")
        ticks: list[float] = []  # a label takes room
        for count in sorted({count for by_count in by_label.values() for count in by_count}):
            if not ticks or count > 1.4 * ticks[-1]:
                ticks.append(count)
        axis.set_xticks(ticks, [f"{count:g}" for count in ticks])
        axis.minorticks_off()
    columns = max(1, min(len(rows), 4, len(labels)))
    figure.set_figheight(figure.get_figheight() + 0.2 * len(labels) / columns)
    figure.legend(
        [drawn[label] for label in labels], [label.replace("`", "") for label in labels],
        loc="outside lower center", fontsize=8, ncols=columns,
    )  # fmt: skip
    plots.save(figure, path)


def draw_methods(
    rates: Mapping[str, Mapping[str, Mapping[str, float]]], names: Sequence[str], path: Path
) -> None:
    """Draws success rates as bars, a panel for each level (paper, figure 'Quantitative Results').

    Args:
        rates: success rates in percent by level, source and method; all levels have equal sources.
        names: names of all methods, in order.
        path: file to write.
    """
    figure, axes = _make_panels(len(rates), columns=3, width=4.5)
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
        titles = [label.replace("`", "") for label in labels]
        figure.legend(handles, titles, loc="outside lower center", ncols=len(titles))
    plots.save(figure, path)


def draw_intervals(found: dict[str, tuple[float, float, float]], path: Path) -> None:
    """Draws aggregate scores with their intervals (Agarwal et al., 2021).

    Args:
        found: score and bounds of its interval in percent, by label.
        path: file to write.
    """
    figure, axis = plt.subplots(figsize=(7, 0.8 + 0.35 * len(found)), layout="constrained")
    for place, (score, low, high) in enumerate(reversed(found.values())):
        axis.barh(place, high - low, left=low, height=0.5, color="C0", alpha=0.6)
        axis.plot([score, score], [place - 0.3, place + 0.3], color="black")
    axis.set_yticks(range(len(found)), [label.replace("`", "") for label in reversed(found)])
    axis.set(xlim=(0, 102))
    axis.set_xlabel("interquartile mean of success (%), 95% interval", fontsize=9)
    axis.grid(axis="x", alpha=0.3)
    plots.save(figure, path)


def draw_landscape(found: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draws energies of good and bad plans over training, and of plans over iterations.

    Args:
        found: measurements of `experiments.landscape`, one for each preset.
        path: file to write.
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
    plots.save(figure, path)


def draw_energies(found: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draws the mean energy of each trajectory against its return, both scaled to 0 .. 1.

    Args:
        found: measurements of `experiments.atari_energy` by game.
        path: file to write.
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
    plots.save(figure, path)


def _make_panels(count: int, columns: int, width: float) -> tuple[Figure, Sequence[Axes]]:
    """Makes a figure of `count` panels of success rates, at most `columns` side by side."""
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
