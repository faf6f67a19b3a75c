"""Writes the results of a run: its row, episodes and pictures."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from leapjax import processes, scores
from leapjax.configuration import list_settings
from leapjax.pretrained import Pretrained
from leapjax.rollouts import Episodes
from leapjax.running import plots, results
from leapjax.running.data import read_outcome
from leapjax.running.evaluate import make_player
from leapjax.running.metrics import read_metrics
from leapjax.running.run import Run


def record(
    run: Run, planner: Pretrained, episodes: Episodes, versions: Mapping[str, str]
) -> results.Row:
    """Writes the row of a run, its episodes and its pictures; returns the row.

    Args:
        run: a finished run.
        planner: planner of the run.
        episodes: held-out episodes that the planner played.
        versions: versions of the code that ran.
    """
    config, folder, experiment = run.config, run.folder, run.experiment
    row = make_row(run, planner, episodes) | {"versions": dict(versions)}
    measured = {"success": "success", "return": "mean_return", "length": "mean_length"}
    run.log(config.training.steps, {f"evaluation/{k}": row[name] for k, name in measured.items()})

    def write() -> None:
        results.write_csv(folder / "episodes.csv", episodes)
        results.record(run.rows, row, episodes if config.record else None)
        if config.pictures:
            draw(run, planner)
            if experiment.animate is not None:
                experiment.animate(planner, run, run.played[:3], folder / "plan.gif")
            run.console.print(f"pictures: {folder}", highlight=False)

    processes.run_on_first(write)
    run.console.print(results.summarize(row))
    return row


def make_row(run: Run, planner: Pretrained, episodes: Episodes) -> results.Row:
    """Makes the JSON row of a finished run."""
    config, lengths = run.config, episodes.lengths
    paper = run.experiment.paper if config.play is None else None  # planners play their own level
    return {
        "experiment": run.experiment.name,
        "domain": config.domain,
        "level": config.level,
        "played": run.domain.held_out.name if run.domain.held_out else run.domain.level,
        "method": config.method,
        "preset": config.preset,
        "seed": run.seed,
        "demos": config.demos,
        "episodes": len(episodes.seeds),
        "first_episode_seed": int(episodes.seeds[0]),
        "validation": config.validation,
        "successes": int(episodes.successes.sum()),
        "success": float(episodes.successes.mean()),
        "mean_return": float(episodes.returns.mean()),
        "return_error": scores.standard_error(episodes.returns),
        "mean_length": float(lengths.mean()),
        "mean_success_length": float(lengths[episodes.successes].mean())
        if episodes.successes.any()
        else None,
        "horizon": config.planner.horizon,
        "iterations": config.planner.iterations,
        "executed": config.executed or config.planner.horizon,
        "checkpoint": config.checkpoint and config.checkpoint.name,
        "train_steps": 0 if config.checkpoint else config.training.steps,
        **{f"{part}_seconds": round(value, 3) for part, value in run.seconds.items()},
        "plans": episodes.plans,
        "passes": episodes.passes / episodes.plans,
        "plans_per_second": episodes.plans / episodes.planning_seconds,
        "params": int(sum(x.size for x in jax.tree.leaves(planner.params))),
        "paper_success": paper and paper(config.level, config.method),
        **describe_success(run),
        "date": results.format_date(),
        "hash": run.name,
        "configuration": list_settings(config, run.seed),
    }


def describe_success(run: Run) -> dict[str, Any]:
    """Returns the fields of a row that define success, if the domain has a criterion for it."""
    config, criterion = run.config, run.domain.demonstrations.criterion
    if criterion is None:
        return {}
    same = config.play in (None, config.level)
    data = read_outcome(config.checkpoint or run.folder) if same else None
    return {
        "criterion": str(criterion),
        "criterion_given": criterion.given,
        "data_success": None if data is None else data[0],
        "data_return": None if data is None else data[1],
    }


def draw(run: Run, planner: Pretrained) -> None:
    """Draws the training curve, and success against iterations if the experiment asks for it."""
    config, folder = run.config, run.folder
    folder.mkdir(parents=True, exist_ok=True)
    metrics = [] if config.checkpoint else read_metrics(folder)
    if metrics:
        plots.draw_training_curve(metrics, folder / "loss.png")
    if not run.experiment.iterations:
        return
    play = make_player(run, planner)
    some = run.played[:100]
    iterations = sorted({1, 2, 3, 5, *np.linspace(1, config.planner.iterations, 5).astype(int)})
    iterations = [int(n) for n in iterations if n <= config.planner.iterations]
    outcomes = [play(some, iteration=n) for n in iterations]
    plots.draw_success_by_iteration(
        iterations, [(int(o.successes.sum()), len(some)) for o in outcomes],
        f"{config.level}, {config.method}, preset {config.preset}", folder / "iterations.png",
    )  # fmt: skip
