"""The schemas of the measurements, from which tables and figures are made, as from rows."""

from pathlib import Path
from typing import Any

from experiments.landscape import CORRUPTED
from experiments.tables.atari import ENCODED
from leapjax.errors import UserError, first_line
from leapjax.files import read_text
from leapjax.running.schema import (
    AMOUNT,
    COUNT,
    POSITIVE,
    SEVERAL,
    Absent,
    Each,
    Named,
    Nullable,
    Number,
    OneOf,
    Schema,
    find_problem,
    parse_json,
)

PART = {"part": str, "ms": POSITIVE, "gflop": AMOUNT}
TRAINING = {
    "level": str, "preset": str, "consecutive": SEVERAL, "steps": COUNT,
    "steps_per_second": POSITIVE, "flops_per_step": AMOUNT, "gflops": AMOUNT,
    "fraction_of_peak": AMOUNT, "training_seconds": AMOUNT, "parts": Each(PART),
}  # fmt: skip
PLANNING = {
    "preset": str, "horizon": SEVERAL, "iterations": SEVERAL, "batch": SEVERAL,
    "seconds": AMOUNT, "plans_per_second": POSITIVE, "gflops": AMOUNT, "peak_gflops": AMOUNT,
    "fraction_of_peak": AMOUNT,
}  # fmt: skip
QUALITY = {
    "variant": str, "level": str, "preset": str, "successes": COUNT, "episodes": SEVERAL,
    "mean_length": AMOUNT, "plans_per_second": POSITIVE,
}  # fmt: skip
DECISIONS = {
    "preset": OneOf(tuple(ENCODED)), "batch": SEVERAL, "planning_seconds": POSITIVE,
    "encoding_seconds": POSITIVE, "anew_seconds": AMOUNT, "playing_seconds": AMOUNT,
    "encoding_flops": AMOUNT, "peak_gflops": Absent(POSITIVE),
}  # fmt: skip
LANDSCAPE = {
    "level": str,
    "preset": str,
    "training": Each({"step": COUNT, **{f"random_{n}": float for n in CORRUPTED}}, least=1),
    "planning": {"mean": Each(float, least=1), "single": Each(Each(float))},
}
ENERGIES = {
    "energies": Each(float, least=2), "returns": Each(float, least=2),
    "correlation": Number(-1, 1), "p_value": Number(0, 1),
}  # fmt: skip
DEMONSTRATOR = {"episodes": SEVERAL, "successes": COUNT, "mean_success_length": Nullable(AMOUNT)}
GAMES = Each({"score": float, "noise": Number(0, 1), "transitions": COUNT}, least=1)
MEASURED: dict[str, Schema] = {
    "planning": Each(PLANNING),
    "training": Each(TRAINING),
    "quality": Each(QUALITY),
    "methods": Each({"level": str, "method": str, "plans_per_second": POSITIVE}),
    "demonstrator": Named(DEMONSTRATOR),
    "landscape": Each(LANDSCAPE, least=1),
    "atari-data": Named(GAMES),
    "atari-energy": Named(ENERGIES, least=1),
    "atari-cost": Each(DECISIONS),
    "atari-training": Each(TRAINING),
}


def read_measured(path: Path) -> Any:
    """Reads the measurements in a file, whose name tells their schema.

    Raises:
        UserError: the file cannot be read, or a field is invalid; names the field.
    """
    try:
        found = parse_json(read_text(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} is not valid JSON ({first_line(error)})") from None
    wrong = find_problem(found, MEASURED[path.stem]) or _find_contradiction(path.stem, found)
    if wrong:
        raise UserError(f"{path}: {wrong}")
    return found


def _find_contradiction(name: str, found: Any) -> str | None:
    """Finds fields that contradict each other; returns a message, or `None`."""
    if name == "quality":
        for row in found:
            if row["successes"] > row["episodes"]:
                return f"{row['successes']} successes of {row['episodes']} episodes"
    if name == "landscape":
        for row in found:
            planning = row["planning"]
            if any(len(single) != len(planning["mean"]) for single in planning["single"]):
                return f"[{found.index(row)}].planning.single has other lengths than its mean"
    if name == "atari-energy":
        for game, of in found.items():
            if len(of["energies"]) != len(of["returns"]):
                return f"[{game!r}] has other numbers of energies and returns"
    return None
