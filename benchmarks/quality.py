"""Measures success and speed of search settings: `python -m benchmarks.quality runs/RUN`.

Measures success on validation levels (never on test levels) and plans per second, for trained
planners and many search settings. The speed is for one batch of contexts, the first states of the
validation levels.
"""

import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.timing import Row, check_writable, fastest, write_rows
from leapjax import pretrained, rollouts
from leapjax.batching import plan_keys
from leapjax.data import seeds
from leapjax.domains.babyai import levels
from leapjax.environments import closing
from leapjax.errors import UserError
from leapjax.planners import FILLS, GibbsConfig
from leapjax.running import jax_setup, plots, shell
from leapjax.scores import wilson_interval

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# Plans per second of the authors' code by (T, N), one plan at a time on two cores.
AUTHORS = {(5, 10): 11.8, (10, 30): 2.9, (15, 50): 1.2}


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure success and speed of search settings."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or levels of published planners."""
    episodes: int = 500
    """Validation episodes for each setting."""
    batch: int = 256
    """Plans per call, for the speed."""
    json: Path | None = None
    """Write the rows here."""
    plot: Path | None = None
    """Draw success against plans per second here."""
    seconds: float = 2.0
    """Time to spend on each measurement of speed, at least."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes the rows to `--json`; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "benchmarks.quality", given)
    return shell.run_program("benchmarks.quality", given, lambda: run(options))


def run(options: Options) -> None:
    """Measures every setting."""
    if not options.runs:
        raise UserError("expected at least one folder of a run, or a level")
    if options.batch < 1:
        raise UserError(f"--batch {options.batch}: at least one plan must be made")
    if options.plot is not None:
        plots.check_figure(options.plot)
    check_writable(options.json)
    folders = [pretrained.find_folder(path) for path in options.runs]
    searches = {}
    for folder in folders:
        specification = pretrained.read_specification(folder)
        if not isinstance(specification.planner, GibbsConfig):
            raise UserError(f"{folder}: {specification.method} does not plan by Gibbs sampling")
        most = levels.find_level(specification.level).iterations
        domain = pretrained.make_domain(specification)
        accepts_mask = pretrained.make_agent(specification, domain).energy.accepts_mask
        searches[folder] = {
            name: search
            for name, search in variants(specification.planner, most).items()
            if accepts_mask or search.fill == "together"
        }
    jax_setup.start()
    rows = [
        measure(options, folder, name, config)
        for folder, configs in searches.items()
        for name, config in configs.items()
    ]
    Console().print(table(rows))
    write_rows(options.json, rows)
    if options.plot:
        draw(rows, options.plot)


def variants(trained: GibbsConfig, most: int) -> dict[str, GibbsConfig]:
    """Makes the search settings to compare, by title; `most` is the paper's N."""
    horizon = trained.horizon

    def search(**options: Any) -> GibbsConfig:
        plain = {"fill": "together", "order": "random", "resampled": 1}
        return dataclasses.replace(trained, **{**plain, **options})

    result = {
        f"all at once, N = {n}": search(iterations=n) for n in sorted({1, 2, 5, horizon, most})
    }
    for order in ("sequential", "uncertain"):
        result[f"all at once, {order}, N = {horizon}"] = search(iterations=horizon, order=order)
    for fill in FILLS[1:]:
        result[f"{fill}, N = {horizon}"] = search(iterations=horizon, fill=fill)
    half = -(-horizon // 2)
    if horizon > 1:
        result[f"all at once, P = 2, N = {half}"] = search(iterations=half, resampled=2)
        result[f"confident, P = 2, N = {half}"] = search(
            iterations=half, resampled=2, fill="confident"
        )
    result[f"confident, best of 4, N = {horizon}"] = search(
        iterations=horizon, fill="confident", restarts=4
    )
    return result


def measure(options: Options, path: Path, name: str, config: GibbsConfig) -> Row:
    """Measures success and speed of one setting."""
    planner = pretrained.load(path, config)
    specification = planner.specification
    domain, context = pretrained.make_domain(specification), specification.context
    firsts = seeds.validation_seeds(0, min(options.batch, options.episodes))
    with closing(domain.make_adapter()) as adapter:
        histories = [
            rollouts.History(adapter.reset(int(seed)), context, adapter.num_actions)
            for seed in np.resize(np.array(firsts), options.batch)
        ]
    contexts = rollouts.stack_contexts(histories)
    keys = plan_keys(0, np.arange(options.batch), np.zeros(options.batch, int))
    planner(keys, contexts)
    taken = fastest(partial(planner, keys, contexts), options.seconds)
    episodes = rollouts.evaluate(
        domain.make_adapter, seeds.validation_seeds(0, options.episodes), planner.plan,
        planner.params, context=context,
    )  # fmt: skip
    row: Row = {
        "variant": name,
        "level": specification.level,
        "preset": specification.origin.preset,
        "horizon": config.horizon,
        "iterations": config.iterations,
        "paper_iterations": levels.find_level(specification.level).iterations,
        "run": path.resolve().name,
        "training_steps": specification.training.steps,
        "plans_per_second": options.batch / taken,
        "episodes": options.episodes,
        "successes": int(episodes.successes.sum()),
        "mean_length": float(episodes.lengths.mean()),
    }
    share = row["successes"] / options.episodes
    print(f"{name}: {share:.1%}, {row['plans_per_second']:.0f} plans/s", flush=True)
    return row


def table(rows: Sequence[Row]) -> Table:
    """Makes a table of the rows for a terminal."""
    result = Table("level", "search", "success", "95% interval", "plans/s", "authors' code x")
    for row in rows:
        low, high = wilson_interval(row["successes"], row["episodes"])
        authors = AUTHORS.get((row["horizon"], row["paper_iterations"]))
        result.add_row(
            f"{row['level']}, {row['preset']}",
            row["variant"],
            f"{row['successes'] / row['episodes']:.1%}",
            f"{low:.1%} to {high:.1%}",
            f"{row['plans_per_second']:.0f}",
            f"{row['plans_per_second'] / authors:.0f}" if authors else "",
        )
    return result


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draws success with its interval against plans per second."""
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for index, row in enumerate(rows):
        share = row["successes"] / row["episodes"]
        low, high = wilson_interval(row["successes"], row["episodes"])
        axes.errorbar(
            row["plans_per_second"], 100 * share,
            yerr=[[100 * (share - low)], [100 * (high - share)]],
            fmt="os^Dv<>P*Xhp"[index % 12], color=f"C{index % 10}", capsize=2,
            label=f"{row['level']}, {row['preset']}: {row['variant']}",
        )  # fmt: skip
    axes.set(
        xscale="log", xlabel="plans per second",
        ylabel=f"success on {rows[0]['episodes']} validation episodes, %",
    )  # fmt: skip
    speeds = [row["plans_per_second"] for row in rows]
    ticks = [t for t in 125.0 * 2.0 ** np.arange(10) if min(speeds) / 1.5 < t < max(speeds) * 1.5]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plots.save(figure, path)


if __name__ == "__main__":
    sys.exit(main())
