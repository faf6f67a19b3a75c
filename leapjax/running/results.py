"""Reads and writes result rows: JSON lines, one file for each experiment."""

import contextlib
import dataclasses
import datetime
import json
import math
import platform
import statistics
import subprocess
import typing
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.table import Table

from leapjax import compilation, scores
from leapjax.checks import LARGEST_SEED
from leapjax.errors import UserError, first_line
from leapjax.files import lock_folder, read_text, write_text, write_whole
from leapjax.planners import PlannerConfig
from leapjax.rollouts import Episodes
from leapjax.running import jax_setup
from leapjax.running.schema import (
    AMOUNT,
    COUNT,
    POSITIVE,
    SEVERAL,
    Absent,
    Nullable,
    Number,
    Schema,
    find_problem,
    parse_json,
)
from leapjax.serialization import read_json
from leapjax.version import find_version

Row = dict[str, Any]
EPISODE = np.dtype([("seed", "<i8"), ("success", "?"), ("return", "<f8"), ("length", "<i4")])
# Fields of every row; a float may be written as an integer.
FIELDS = {
    "experiment": str, "domain": str, "level": str, "method": str, "preset": str, "hash": str,
    "seed": int, "episodes": int, "successes": int, "mean_length": float,
    "compile_seconds": float, "train_seconds": float, "eval_seconds": float,
    "plans_per_second": float,
}  # fmt: skip
ROW: dict[str, Schema] = {
    **FIELDS,
    "seed": Number(0, LARGEST_SEED, whole=True),
    "episodes": SEVERAL,
    "successes": COUNT,
    "mean_length": POSITIVE,
    "compile_seconds": AMOUNT,
    "train_seconds": AMOUNT,
    "eval_seconds": AMOUNT,
    "plans_per_second": POSITIVE,
    # Fields that only some rows have, and that a terminal shows.
    "success": Absent(Number(0, 1)),
    "demos_seconds": Absent(AMOUNT),
    "mean_return": Absent(float),
    "paper_success": Absent(Nullable(Number(0, 100))),
    "checkpoint": Absent(Nullable(str)),
    "configuration": Absent({"planner": Absent(dict)}),
}
# Rows of an experiment, and of an analysis, with the fields that tables read.
OF_EXPERIMENT: dict[str, Schema] = {
    **ROW,
    "train_steps": COUNT,
    "iterations": SEVERAL,
    "plans": SEVERAL,
    "passes": Absent(POSITIVE),
    "mean_return": float,
    "return_error": Absent(Nullable(AMOUNT)),
    "configuration": {"planner": {"temperature": Absent(AMOUNT)}},
}
OF_ANALYSIS: dict[str, Schema] = {
    **ROW,
    "case": str,
    "way": str,
    "plans": SEVERAL,
    "first_pass_successes": Nullable(COUNT),
    "violations": Nullable(COUNT),
    "paper_success": Nullable(Number(0, 100)),
    "versions": {"machine": str},
}


def read(path: Path, schema: Schema = ROW) -> list[Row]:
    """Reads the rows of a file; [] if there is no file.

    Args:
        path: file of rows.
        schema: schema of each row.

    Raises:
        UserError: a line is not a row, or two rows have the same hash, so that a table would count
            a seed twice; names the line.
    """
    if not path.exists():
        return []
    rows = []
    line_of: dict[str, int] = {}  # by hash
    # `splitlines` would also split at other line ends, which a JSON text may contain.
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        if not line.strip():
            continue
        try:
            row = parse_json(line)
        except (ValueError, RecursionError) as error:
            reason = "" if isinstance(error, json.JSONDecodeError) else f" ({first_line(error)})"
            raise UserError(f"{path}, line {number}: not JSON{reason}") from None
        wrong = find_problem(row, schema) or _find_contradiction(row)
        if wrong:
            raise UserError(f"{path}, line {number}: {wrong}")
        row["success"] = compute_success(row)  # rows of an earlier version have only counts
        first = line_of.setdefault(row["hash"], number)
        if first != number:
            raise UserError(
                f"{path}, line {number}: the same hash, {row['hash'][:20]}, as line {first}, so "
                "both are of one run: delete one of them"
            )
        rows.append(row)
    return rows


def _find_contradiction(row: Row) -> str | None:
    """Describes how fields of a row contradict each other; returns `None` if they agree."""
    for name in ("successes", "first_pass_successes"):
        if (row.get(name) or 0) > row["episodes"]:
            return f"{row[name]} {name} of {row['episodes']} episodes"
    if not math.isclose(
        row.get("success", compute_success(row)), compute_success(row), abs_tol=1e-9
    ):
        return f"success is {row['success']}, of {row['successes']} of {row['episodes']} episodes"
    return None


def compute_success(row: Row) -> float:
    """Returns the success rate of a row, as a fraction."""
    return row["successes"] / row["episodes"]


def choose_folder(recorded: bool, runs: Path) -> Path:
    """Returns the folder of rows: `results`, which is committed, or the folder of the runs."""
    return Path("results") if recorded else runs


def record(path: Path, row: Row, episodes: Episodes | None = None) -> None:
    """Writes a row and its episodes atomically; replaces the row with the same hash.

    Args:
        path: file of rows.
        row: row to add.
        episodes: episodes of the row; `read_episodes` returns them.

    Raises:
        UserError: the row holds a number that is not finite, which JSON cannot represent.
    """
    for name, value in row.items():
        try:
            json.dumps(value, allow_nan=False)
        except ValueError:
            raise UserError(f"{path}: {name} of a new row is not finite: {value}") from None
    with lock_folder(path.parent, wait=True):
        rows = [other for other in read(path) if other["hash"] != row["hash"]]
        # Episodes before their row, and no row while its episodes change: a process that is killed
        # in between leaves episodes without a row, which the next process drops.
        known, hashes = read_episodes(path), {other["hash"] for other in rows}
        if row["hash"] in known:
            _write_rows(path, rows)
        tables = {name: each for name, each in known.items() if name in hashes}
        if episodes is not None:
            tables[row["hash"]] = as_table(episodes)
        if tables or known:
            _write_episodes(_locate_episodes(path), tables)
        _write_rows(path, [*rows, row])


def _write_rows(path: Path, rows: Sequence[Row]) -> None:
    lines = (json.dumps(row, sort_keys=True) for row in rows)
    write_text(path, "".join(f"{line}\n" for line in lines))


def change(path: Path, changed: Callable[[Any], Any]) -> Any:
    """Rewrites a JSON file atomically; `changed` maps its value, or `None`, to the new value."""
    with lock_folder(path.parent, wait=True):
        found = changed(read_json(path) if path.exists() else None)
        write_text(path, json.dumps(found, indent=1) + "\n")
    return found


def add(path: Path, name: str, value: Any) -> dict[str, Any]:
    """Adds or replaces a named value in a JSON file; returns all values."""
    return change(path, lambda known: {**(known or {}), name: value})


def as_table(episodes: Episodes) -> np.ndarray:
    """Returns the outcome of each episode: an array `[E]` with the fields of `EPISODE`."""
    columns = episodes.seeds, episodes.successes, episodes.returns, episodes.lengths
    return np.array(list(zip(*columns, strict=True)), EPISODE)


def write_csv(path: Path, episodes: Episodes) -> None:
    """Writes the outcome of each episode as CSV."""
    lines = (f"{seed},{good:d},{total:.6g},{n}" for seed, good, total, n in as_table(episodes))
    write_text(path, "\n".join([",".join(EPISODE.names or ()), *lines]) + "\n")


def _locate_episodes(path: Path) -> Path:
    """Returns the file of the episodes of a file of rows."""
    return path.parent / "episodes" / f"{path.stem}.npz"


def read_episodes(path: Path) -> dict[str, np.ndarray]:
    """Reads the recorded episodes of rows; some rows have no episodes.

    Args:
        path: file of the rows.

    Returns:
        By the hash of the row: `[E]` with the fields of `EPISODE`.

    Raises:
        UserError: the file of episodes is damaged.
    """
    path = _locate_episodes(path)
    if not path.exists():
        return {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
    except Exception as error:  # noqa: BLE001  # zipfile raises many kinds
        raise UserError(f"cannot read {path}: {first_line(error)}") from None
    for name, table in found.items():
        if table.dtype != EPISODE or table.ndim != 1:
            raise UserError(f"{path}: {name} is an array of {table.dtype}, not of episodes")
    return found


def _write_episodes(path: Path, tables: Mapping[str, np.ndarray]) -> None:
    # One array per row: when a row is added, git stores its array and shares the others.
    arrays: Any = tables  # NumPy's stubs take the arrays for its other arguments
    with write_whole(path) as scratch:
        np.savez_compressed(scratch, **arrays)


def find(path: Path, configuration: str) -> Row | None:
    """Returns the row with the hash of a configuration; `None` if no row has it."""
    return next((row for row in read(path) if row["hash"] == configuration), None)


def find_versions() -> dict[str, str]:
    """Returns the versions of the packages and the machine; starts JAX."""
    found = {}
    for name in ("jax", "flax", "optax", "minigrid", "numpy", "ale-py"):
        with contextlib.suppress(metadata.PackageNotFoundError):  # of an extra
            found[name] = metadata.version(name)
    found["leapjax"] = find_version() + find_code_version(Path(__file__).parent.parent.parent)
    machine = f"{compilation.name_processor()}, cores: {jax_setup.count_cores()}"
    devices = jax.local_devices()
    if devices[0].platform != "cpu":
        machine += f", {len(devices)} {devices[0].device_kind}"
    return {**found, "python": platform.python_version(), "machine": machine}


def find_code_version(root: Path) -> str:
    """Returns the commit that last changed the code, as a local version: "+g1a2b3c4".

    Adds ".dirty" if the code differs from that commit; returns "" without a repository. Later
    commits may change other files, such as rows.
    """
    code = ("--", "leapjax", "experiments", "benchmarks")

    def git(*arguments: str) -> str:
        command = ("git", "-C", str(root), *arguments, *code)
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    if not (root / ".git").exists():
        return ""
    try:
        changed = git("status", "--porcelain")
        return f"+g{git('log', '-1', '--format=%h')}{'.dirty' if changed else ''}"
    except (OSError, subprocess.CalledProcessError):
        return ""


def format_date() -> str:
    """Returns today's date as text."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def format_rate(row: Row) -> str:
    """Formats a success rate with its 95% interval."""
    return _format_with_interval(
        compute_success(row), scores.wilson_interval(row["successes"], row["episodes"])
    )


def format_rate_over_seeds(rows: Sequence[Row]) -> str:
    """Formats the mean success rate over training seeds with its 95% interval."""
    counts = [row["successes"] for row in rows], [row["episodes"] for row in rows]
    mean = statistics.fmean(map(compute_success, rows))
    return _format_with_interval(mean, scores.interval_over_seeds(*counts))


def _format_with_interval(rate: float, interval: tuple[float, float]) -> str:
    return f"{rate:.1%} [{interval[0]:.1%}, {interval[1]:.1%}]"


def group_seeds(rows: Sequence[Row], key: Callable[[Row], Any]) -> list[list[Row]]:
    """Groups rows that differ only in their training seed; leaves out groups of one row.

    Args:
        rows: rows of any seeds.
        key: (row) -> a value that tells rows apart by everything except the seed.
    """
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return [group for group in groups.values() if len(group) > 1]


def summarize(row: Row) -> str:
    """Summarises a row in one line."""
    published = "" if row.get("paper_success") is None else f", published {row['paper_success']}%"
    parts = [f"success {format_success(row)}", f"mean length {row['mean_length']:.1f}{published}"]
    if "criterion" not in row:
        return ", ".join(parts)
    total = f"mean return {format_return(row)}"
    parts.insert(1 if row.get("criterion_given") else 0, total)
    return f"{', '.join(parts)}; success: {row['criterion']}"


def format_success(row: Row) -> str:
    """Formats the success rate of a row, and of its data if known."""
    data = _find_number(row, "data_success")
    return format_rate(row) + ("" if data is None else f" (data: {data:.1%})")


def format_return(row: Row) -> str:
    """Formats the mean return of a row, and of its data if known."""
    mean, data = _find_number(row, "mean_return"), _find_number(row, "data_return")
    return ("-" if mean is None else f"{mean:.2f}") + (
        "" if data is None else f" (data: {data:.2f})"
    )


def _find_number(row: Row, name: str) -> float | None:
    """Returns an optional number of a row; `None` if the row lacks it."""
    value = row.get(name)
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def name_planner(row: Row) -> str:
    """Returns a short name of the planner of a row: its settings that are not the usual ones."""
    configuration = row.get("configuration", {})
    planner, rules = configuration.get("planner", {}), configuration.get("rules", 0)
    # A row does not say what kind of planner it is of, so the default of any kind is usual.
    kinds = [dataclasses.asdict(kind()) for kind in typing.get_args(PlannerConfig)]
    shown = ("iterations", "fill", "horizon", "score", "score_trace")  # "fill" first; or of no use
    others = [
        f"{name.replace('_', ' ')} {value}"
        for name, value in planner.items()
        if name not in shown and all(value != kind.get(name, kind) for kind in kinds)
    ]
    parts = {
        f"N = {planner.get('iterations')}": "iterations" in planner,
        str(planner.get("fill")): planner.get("fill", "together") != "together",
        **dict.fromkeys(others, True),
        f"rules {rules}": bool(rules),
        f"learned {row['level']}": row.get("played", row["level"]) != row["level"],
    }
    return ", ".join(part for part, said in parts.items() if said)


def make_success_table(rows: Sequence[Row]) -> Table:
    """Makes a table of success rates beside the published ones, and of means over seeds.

    The mean return comes first if the user did not give the criterion of success of some row.
    """
    measures = {
        "success [95%]": (format_success, format_rate_over_seeds),
        "return": (format_return, _format_mean_return),
    }
    if any("criterion" in row and not row.get("criterion_given") for row in rows):
        measures = dict(reversed(measures.items()))
    criteria = sorted({f"success: {row['criterion']}" for row in rows if "criterion" in row})
    result = Table(
        *("level", "method", "planner", "seed", *measures, "length", "published"),
        caption="\n".join(criteria) or None,
    )

    def named(row: Row) -> tuple[str, ...]:
        played = str(row.get("played", row["level"]))
        return played, f"{row['method']} ({row['preset']})", name_planner(row)

    def published(row: Row) -> str:
        found = row.get("paper_success")
        return "-" if found is None else f"{found:.1f}%"

    for row in rows:
        said = (measure(row) for measure, _ in measures.values())
        length = f"{row['mean_length']:.1f}"
        result.add_row(*named(row), str(row["seed"]), *said, length, published(row))
    result.add_section()

    def identify(row: Row) -> tuple[str, ...]:
        same = {**row.get("configuration", {}), "seed": None}
        return *named(row), json.dumps(same, sort_keys=True)

    for group in group_seeds(rows, identify):
        said = (measure(group) for _, measure in measures.values())
        length = f"{statistics.fmean(row['mean_length'] for row in group):.1f}"
        seeds = f"mean of {len(group)}"
        result.add_row(*named(group[0]), seeds, *said, length, published(group[0]))
    return result


def _format_mean_return(rows: Sequence[Row]) -> str:
    returns = [_find_number(row, "mean_return") for row in rows]
    known = [each for each in returns if each is not None]
    return f"{statistics.fmean(known):.2f}" if len(known) == len(rows) else "-"


def make_time_table(rows: Sequence[Row]) -> Table:
    """Makes a table of the seconds that each part of the runs took."""
    parts = ("demos", "compile", "train", "eval")
    result = Table("level", "seed", *(f"{part} (s)" for part in parts), "plans/s")
    for row in rows:
        seconds = (f"{row.get(f'{part}_seconds', 0):.1f}" for part in parts)
        result.add_row(row["level"], str(row["seed"]), *seconds, f"{row['plans_per_second']:.0f}")
    return result
