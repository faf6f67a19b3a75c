"""What each way to search costs and gives: `python -m benchmarks.quality runs/RUN`.

Success on validation levels (never on test levels) against plans per second, for one
trained planner and many search settings. Speed is measured at one batch of contexts, the
first states of those levels.
"""

import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import matplotlib
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.timing import Row, fastest, write_rows
from experiments.common import program, runtime
from leapjax import pretrained, rollouts
from leapjax.babyai import levels
from leapjax.batching import plan_keys
from leapjax.data import seeds
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig
from leapjax.scores import wilson_interval

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# Plans per second of the authors' code, by (T, N), one by one on two cores.
AUTHORS = {(5, 10): 11.8, (10, 30): 2.9, (15, 50): 1.2}


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure success and speed of search settings."""

    run: Annotated[Path, tyro.conf.Positional]
    """The folder of a run."""
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
    """Measures every setting, prints a table, and writes what was asked for."""
    given = program.arguments_of(arguments)
    options = tyro.cli(Options, args=given)
    return program.guarded("benchmarks.quality", given, lambda: run(options))


def run(options: Options) -> None:
    """Measures every setting."""
    runtime.start()
    specification = pretrained.read_specification(options.run)
    if not isinstance(specification.planner, GibbsConfig):
        raise UserError(f"{options.run}: {specification.method} does not plan by Gibbs sampling")
    paper = levels.find_level(specification.level).iterations
    configs = variants(specification.planner, paper)
    rows = [measure(options, name, config) for name, config in configs.items()]
    Console().print(table(rows))
    write_rows(options.json, rows)
    if options.plot:
        draw(rows, options.plot)


def variants(trained: GibbsConfig, most: int) -> dict[str, GibbsConfig]:
    """Search settings to compare, by what to call them; the paper's N is `most`."""
    greedy = dataclasses.replace(trained, temperature=0.0)
    result = {}
    for n in sorted({1, 2, 3, 5, 10, most}):
        if n <= most:
            result[f"random, N = {n}"] = dataclasses.replace(trained, iterations=n)
            result[f"random, N = {n}, temperature 0"] = dataclasses.replace(greedy, iterations=n)
    half = max(2, most // 2)
    result[f"sequential, N = {half}"] = dataclasses.replace(
        trained, iterations=half, order="sequential"
    )
    if trained.horizon > 1:
        result[f"random, N = {half}, P = 2"] = dataclasses.replace(
            trained, iterations=half, resampled=2
        )
    result["best of 4, N = 3"] = dataclasses.replace(trained, iterations=min(3, most), restarts=4)
    return result


def measure(options: Options, name: str, config: GibbsConfig) -> Row:
    """Success and speed of one setting."""
    planner = pretrained.load(options.run, config)
    specification = planner.specification
    domain, context = pretrained.make_domain(specification), specification.context
    adapter = domain.make_adapter()
    firsts = seeds.validation_seeds(0, min(options.batch, options.episodes))
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
        "horizon": config.horizon,
        "iterations": config.iterations,
        "paper_iterations": levels.find_level(specification.level).iterations,
        "run": options.run.resolve().name,
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
    """The rows for a terminal."""
    result = Table("search", "success", "95% interval", "plans/s", "authors' code x")
    for row in rows:
        low, high = wilson_interval(row["successes"], row["episodes"])
        authors = AUTHORS.get((row["horizon"], row["paper_iterations"]))
        result.add_row(
            row["variant"],
            f"{row['successes'] / row['episodes']:.1%}",
            f"{low:.1%} to {high:.1%}",
            f"{row['plans_per_second']:.0f}",
            f"{row['plans_per_second'] / authors:.0f}" if authors else "",
        )
    return result


def draw(rows: Sequence[Row], path: Path) -> None:
    """Success with its interval against plans per second."""
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for index, row in enumerate(rows):
        share = row["successes"] / row["episodes"]
        low, high = wilson_interval(row["successes"], row["episodes"])
        axes.errorbar(
            row["plans_per_second"], 100 * share,
            yerr=[[100 * (share - low)], [100 * (high - share)]],
            fmt="os^Dv<>P*Xhp"[index % 12], color=f"C{index % 10}", capsize=2,
            label=row["variant"],
        )  # fmt: skip
    axes.set(
        xscale="log", xlabel="plans per second",
        ylabel=f"success on {rows[0]['episodes']} validation episodes, %", title=rows[0]["level"],
    )  # fmt: skip
    speeds = [row["plans_per_second"] for row in rows]
    ticks = [t for t in 125.0 * 2.0 ** np.arange(10) if min(speeds) / 1.5 < t < max(speeds) * 1.5]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
