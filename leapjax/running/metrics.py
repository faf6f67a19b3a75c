"""The training curve of a run, as CSV in its folder."""

import csv
import math
from pathlib import Path

from leapjax import files
from leapjax.errors import UserError, first_line

Metrics = list[dict[str, float]]


def write_metrics(folder: Path, metrics: Metrics) -> None:
    """Writes the training curve as CSV."""
    lines = [",".join(metrics[0])]
    lines += [",".join(repr(value) for value in entry.values()) for entry in metrics]
    files.write_text(folder / "metrics.csv", "\n".join(lines) + "\n")


def resume_metrics(folder: Path, step: int) -> Metrics:
    """Drops what a training curve says of later steps, also in its file; returns the rest.

    A run that was killed may have written its curve, but not the checkpoint of that step.

    Raises:
        UserError: the file is damaged.
    """
    before = read_metrics(folder)
    metrics = [entry for entry in before if entry["step"] <= step]
    if not metrics:
        (folder / "metrics.csv").unlink(missing_ok=True)
    elif len(metrics) < len(before):
        write_metrics(folder, metrics)
    return metrics


def read_metrics(folder: Path) -> Metrics:
    """Reads the training curve so far.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / "metrics.csv"
    if not path.exists():
        return []
    lines = files.read_text(path).splitlines()
    try:
        metrics = [{k: float(v) for k, v in entry.items()} for entry in csv.DictReader(lines)]
        if any(not entry.keys() >= {"step", "seconds", "loss"} for entry in metrics):
            raise ValueError("a column is missing")
        if not all(math.isfinite(e["step"]) and math.isfinite(e["seconds"]) for e in metrics):
            raise ValueError("a step or a time is not a number")
    except (TypeError, ValueError, csv.Error) as error:
        raise UserError(
            f"{path} is damaged ({first_line(error)}): remove it, and the run goes on with a "
            "training curve that begins here"
        ) from None
    return metrics
