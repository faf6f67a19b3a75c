"""Plans per second against this machine's limit: `python -m benchmarks.planning --quick`.

Parameters are random, because speed does not depend on them. Compilation is timed apart. Every time
is the best of several calls. FLOPs count all matrix products of a plan and its encoder. The peak is
measured in the same run, on the shapes of a transformer layer.
"""

import dataclasses
import resource
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.flops import matmul_flops
from benchmarks.timing import Row, check_writable, fastest, matmul_peak, write_rows
from leapjax import pretrained
from leapjax.batching import CHUNK_SIZES, compile_planner, plan_keys, split_batch
from leapjax.configuration import AnyConfig, change, make_domain, specify
from leapjax.domain import Domain, blank_context
from leapjax.domains.babyai import levels
from leapjax.domains.babyai.levels import Level
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig, bind
from leapjax.presets import find_preset
from leapjax.running import jax_setup, plots, shell
from leapjax.types import Energy, Params

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# One for each of the paper's (T, N): (5, 10), (10, 30) and (15, 50), on grids of side 7, 10, 19.
LEVELS = ("GoToLocalS7N5", "GoToObjMazeS4", "GoToObjMazeS7")
COMPARED = ("paper", "leapjax")
BATCHES = (1, 4, 16, 64, 256, 1024)


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure batched planning."""

    quick: bool = False
    """Only the first level, (T, N) = (5, 10), at batch 1 and 256."""
    batches: tuple[int, ...] = BATCHES
    """Plans in a call."""
    chunks: tuple[int, ...] = CHUNK_SIZES
    """Chunks that a batch is cut into; a GPU wants larger ones than a core."""
    large: int = 0
    """Also plan so many contexts of the last level in one call, and report the memory it took."""
    json: Path | None = None
    """Write the rows here."""
    plot: Path | None = None
    """Draw plans per second and fraction of peak against batch size here."""
    seconds: float = 1.0
    """Least time for each measurement."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes the rows to `--json`; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "benchmarks.planning", given)
    return shell.run_program("benchmarks.planning", given, lambda: run(options))


def run(options: Options) -> None:
    """Measures both presets on every level.

    Raises:
        UserError: a file that cannot be written, or a size below its minimum.
    """
    if options.plot is not None:
        plots.check_figure(options.plot)
    if options.large < 0:
        raise UserError(f"--large must be at least 0, got {options.large}")
    for name, sizes in (("batches", options.batches), ("chunks", options.chunks)):
        if not sizes or min(sizes) < 1:
            raise UserError(f"--{name} {' '.join(map(str, sizes))}: expected positive numbers")
    check_writable(options.json)
    jax_setup.start(cache=False)  # compile times are real
    chosen = [levels.find_level(name) for name in (LEVELS[:1] if options.quick else LEVELS)]
    batches = (1, 256) if options.quick else options.batches
    console = Console()
    rows = []
    for level in chosen:
        for name in COMPARED:
            rows += measure(name, level, batches, options.seconds, options.chunks)
            console.print(f"measured {name} on {level.name}")
    compare_with_peak(rows)
    console.print(table(rows))
    if options.large:
        for name in COMPARED:
            console.print(plan_many(name, levels.find_level(LEVELS[-1]), options.large))
    write_rows(options.json, rows)
    if options.plot:
        draw(rows, options.plot)


def measure(
    name: str,
    level: Level,
    batches: Sequence[int],
    seconds: float,
    chunks: Sequence[int],
) -> list[Row]:
    """Measures one preset and level at every batch size."""
    model, horizon = find_preset("babyai", level.name, "leap", name).model, level.horizon
    search = GibbsConfig(horizon, level.iterations)
    energy, params, domain = make_energy(name, level)
    planner = compile_planner(energy, search, chunks)
    one = jax.random.key(0), blank_context(domain, level.context)
    flops = matmul_flops(bind(energy, search), params, *one)
    rows: list[Row] = []
    compiled: set[int] = set()
    for batch in batches:
        keys = jax.random.split(jax.random.key(1), batch)
        contexts = jax.device_put(random_contexts(domain, level.context, batch))
        begun = time.perf_counter()
        jax.block_until_ready(planner(params, keys, contexts))
        first = time.perf_counter() - begun
        best = fastest(partial(planner, params, keys, contexts), seconds)
        sizes_used = {size for _, size, _ in split_batch(batch, planner.chunk_sizes)}
        new, chunk = sizes_used - compiled, max(sizes_used)
        compiled |= sizes_used
        tokens = chunk * (horizon if model.architecture == "leapjax" else 2 * horizon)
        rows.append(
            {
                "preset": name,
                "level": level.name,
                "horizon": horizon,
                "iterations": level.iterations,
                "side": domain.blank.grid.shape[0],
                "batch": batch,
                "chunk": chunk,
                # 0 if smaller batches have compiled all chunk sizes of this batch
                "compile_seconds": first - best if new else 0.0,
                "seconds": best,
                "plans_per_second": batch / best,
                "flops_per_plan": flops,
                "tokens": tokens,
                "gflops": batch * flops / best / 1e9,
                "peak_gflops": matmul_peak(tokens, model.width, seconds),
            }
        )
    return rows


def compare_with_peak(rows: Sequence[Row]) -> None:
    """Adds `fraction_of_peak`, relative to the best peak measured for the row's shapes."""
    peaks: dict[int, float] = {}
    for row in rows:
        peaks[row["tokens"]] = max(row["peak_gflops"], peaks.get(row["tokens"], 0.0))
    for row in rows:
        row["peak_gflops"] = peaks[row["tokens"]]
        row["fraction_of_peak"] = row["gflops"] / row["peak_gflops"]


def make_energy(name: str, level: Level) -> tuple[Energy, Params, Domain]:
    """Makes a preset's energy with random parameters and the appendix's horizon."""
    default = find_preset("babyai", level.name, "leap", name)
    return untrained(change(default, planner={"horizon": level.horizon}))


def untrained(config: AnyConfig) -> tuple[Energy, Params, Domain]:
    """Makes the energy of a configuration, random parameters, and the domain."""
    domain = make_domain(config)
    agent = pretrained.make_agent(specify(config, 0, domain), domain)
    return agent.energy, jax.jit(agent.init)(jax.random.key(0)).params, domain


def plan_many(name: str, level: Level, count: int) -> str:
    """Plans for very many contexts in one call; returns a line with its time and memory."""
    energy, params, domain = make_energy(name, level)
    planner = compile_planner(energy, GibbsConfig(level.horizon, level.iterations))
    contexts = random_contexts(domain, level.context, count)
    keys = plan_keys(0, np.arange(count), np.zeros(count, int))
    begun = time.perf_counter()
    planner(params, keys, contexts)
    taken = time.perf_counter() - begun
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return (
        f"{name}: {count} plans of ({level.horizon}, {level.iterations}) in {taken:.0f} s, "
        f"compilation included; at most {most:.2f} GiB of memory in the whole process"
    )


def random_contexts(domain: Domain, length: int, batch: int) -> Any:
    """Makes `[B]` random contexts of the right shapes, as NumPy arrays.

    BabyAI: random grids and poses, and one instruction. Atari: random frames.
    """
    blank, rng = blank_context(domain, length), np.random.default_rng(2)
    contexts = jax.tree.map(lambda x: np.repeat(x[None], batch, axis=0), blank)
    if isinstance(blank.observation, np.ndarray):
        frames = [
            rng.integers(0, 256, leaf.shape).astype(np.uint8)
            for leaf in (contexts.observation, contexts.past)
        ]
        return contexts._replace(observation=frames[0], past=frames[1])
    pose = rng.integers(1, 4, (batch, 3)).astype(np.int32)
    observation = contexts.observation._replace(
        grid=rng.integers(0, 4, contexts.observation.grid.shape).astype(np.uint8),
        pose=pose, goal=pose[:, 1:],
        instruction=np.ones_like(contexts.observation.instruction),
    )  # fmt: skip
    return contexts._replace(observation=observation)


def table(rows: Sequence[Row]) -> Table:
    """Makes a table of the rows for a terminal."""
    result = Table("preset", "T, N", "batch", "compile s", "plans/s", "GFLOP/s", "peak", "fraction")
    for row in rows:
        result.add_row(
            row["preset"],
            f"{row['horizon']}, {row['iterations']}",
            str(row["batch"]),
            f"{row['compile_seconds']:.1f}",
            f"{row['plans_per_second']:.0f}",
            f"{row['gflops']:.1f}",
            f"{row['peak_gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
        )
    return result


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draws plans per second, and the fraction of the peak, against batch size."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    for name in COMPARED:
        for horizon, iterations in dict.fromkeys((r["horizon"], r["iterations"]) for r in rows):
            chosen = [r for r in rows if (r["preset"], r["horizon"]) == (name, horizon)]
            label = f"{name}, T = {horizon}, N = {iterations}"
            batches = [row["batch"] for row in chosen]
            left.plot(batches, [r["plans_per_second"] for r in chosen], "o-", label=label)
            right.plot(batches, [100 * r["fraction_of_peak"] for r in chosen], "o-")
    left.set(xlabel="batch", ylabel="plans per second", xscale="log", yscale="log")
    right.set(xlabel="batch", ylabel="% of matrix-multiply peak", xscale="log", ylim=(0, 100))
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    plots.save(figure, path)


if __name__ == "__main__":
    sys.exit(main())
