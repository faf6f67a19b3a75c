"""Measures a plan of each method: `python -m benchmarks.methods`.

Parameters are random, because speed does not depend on them. Methods take turns, and each keeps its
fastest call, so that a slow spell of the machine affects all alike.
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import jax
from rich.console import Console
from rich.table import Table

from benchmarks.planning import random_contexts, untrained
from benchmarks.timing import Row, check_writable, fastest, write_rows
from experiments.tables.babyai import COMPARED
from leapjax.batching import compile_planner
from leapjax.domains.babyai import levels
from leapjax.presets import find_preset
from leapjax.running import jax_setup, shell
from leapjax.running.limits import check_counts

METHODS = tuple(name for name in COMPARED if name != "random")


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure a plan of every method, with preset `leapjax`."""

    level: str = "GoToLocalS8N7"
    """A level of BabyAI."""
    batch: int = 256
    """Plans in one call."""
    rounds: int = 5
    """Turns of each method."""
    seconds: float = 0.5
    """Least time for each turn."""
    json: Path | None = None
    """Write the rows here."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes the rows to `--json`; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "benchmarks.methods", given)
    return shell.run_program("benchmarks.methods", given, lambda: run(options))


def run(options: Options) -> None:
    """Measures every method on one level.

    Raises:
        UserError: an unknown level, a count below 1, or a file that cannot be written.
    """
    check_counts(options, "batch", "rounds")
    level = levels.find_level(options.level)
    check_writable(options.json)
    jax_setup.start(cache=False)
    calls = {method: make_call(level.name, method, options.batch) for method in METHODS}
    best = dict.fromkeys(METHODS, float("inf"))
    for _ in range(options.rounds):
        for method, call in calls.items():
            best[method] = min(best[method], fastest(call, options.seconds))
    rows: list[Row] = [
        {
            "level": level.name,
            "method": method,
            "preset": "leapjax",
            "batch": options.batch,
            "plans_per_second": options.batch / seconds,
        }
        for method, seconds in best.items()
    ]
    Console().print(table(rows))
    write_rows(options.json, rows)


def make_call(level: str, method: str, batch: int) -> Callable[[], object]:
    """Compiles a call that makes `batch` plans."""
    config = find_preset("babyai", level, method, "leapjax")
    energy, params, domain = untrained(config)
    planner = compile_planner(energy, config.planner)
    contexts = jax.device_put(random_contexts(domain, config.context, batch))
    call = partial(planner, params, jax.random.split(jax.random.key(1), batch), contexts)
    begun = time.perf_counter()
    jax.block_until_ready(call())
    print(f"{method}: compiled in {time.perf_counter() - begun:.0f} s", flush=True)
    return call


def table(rows: Sequence[Row]) -> Table:
    """Makes a table of the rows for a terminal."""
    result = Table("method", "plans/s", "ms per plan")
    for row in rows:
        speed = row["plans_per_second"]
        result.add_row(row["method"], f"{speed:,.0f}", f"{1e3 / speed:.2f}")
    return result


if __name__ == "__main__":
    sys.exit(main())
