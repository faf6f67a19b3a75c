"""Measures playing and training on Atari: `python -m benchmarks.atari`.

Playing: the milliseconds of a decision in several games together, divided into emulator, encoder
and planner. The encoder's speed stands against the matrix-multiply peak of the same run. Training:
steps, as `benchmarks.training` measures them.
"""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np
from jax.sharding import NamedSharding
from rich.console import Console
from rich.table import Table

from benchmarks import training
from benchmarks.flops import matmul_flops
from benchmarks.planning import random_contexts
from benchmarks.timing import Row, check_writable, fastest, matmul_peak, write_rows
from experiments.tables.atari import describe_encoding
from leapjax import pretrained, sharding
from leapjax.batching import compile_planner
from leapjax.configuration import AnyConfig, change, make_domain, specify
from leapjax.domain import Domain
from leapjax.environments import Eager, closing
from leapjax.errors import UserError
from leapjax.presets import find_preset
from leapjax.running import jax_setup, shell
from leapjax.types import Context, Params, PyTree

GAMES_PLAYED = (1, 16, 64)  # games played together
DECISIONS = 50  # measured decisions of each game


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure training and playing."""

    games: tuple[str, ...] = ("Breakout",)
    """Games to play."""
    presets: tuple[str, ...] = ("leapjax", "paper")
    """Presets to measure."""
    batches: tuple[int, ...] = GAMES_PLAYED
    """Numbers of games played together."""
    training: bool = True
    """Measure training too."""
    consecutive: int = 16
    """Consecutive windows in an example of preset `paper`; also measures windows drawn alone."""
    json: Path | None = None
    """Write the rows of playing here."""
    training_json: Path | None = None
    """Write the rows of training here."""
    seconds: float = 3.0
    """Least time for each measurement."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints tables, and writes the rows; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "benchmarks.atari", given)
    return shell.run_program("benchmarks.atari", given, lambda: run(options))


def run(options: Options) -> None:
    """Measures every game and preset.

    Raises:
        UserError: no games to play, a file that cannot be written, or `training_json` without
            `training`.
    """
    if any(batch < 1 for batch in options.batches):
        raise UserError(f"--batches {min(options.batches)}: at least one game must be played")
    if options.training_json and not options.training:
        raise UserError("--training-json with --no-training: there are no rows to write; drop one")
    check_writable(options.json, options.training_json)
    jax_setup.start(cache=False)  # compile times are real
    # The longest game only sizes a table of the paper's network.
    configs = [
        change(find_preset("atari", game, "leap", name), domain_settings={"max_steps": 1000})
        for game in options.games
        for name in options.presets
    ]
    papers = [config for config in configs if config.model.architecture == "paper"]
    try:
        in_sequence = [
            change(config, training={"consecutive": options.consecutive}) for config in papers
        ]
    except ValueError as error:
        raise UserError(f"--consecutive {options.consecutive}: {error}") from None
    console = Console()
    playing = [
        row for config in configs for row in measure(config, options.batches, options.seconds)
    ]
    console.print(*tables(playing), sep="\n")
    write_rows(options.json, playing)
    if options.training:
        trained = [training.measure(config, options.seconds) for config in [*configs, *in_sequence]]
        console.print(training.table(trained))
        write_rows(options.training_json, trained)


def measure(config: AnyConfig, batches: Sequence[int], seconds: float) -> list[Row]:
    """Measures one preset of one game, for each number of games played together."""
    domain = make_domain(config)
    agent = pretrained.make_agent(specify(config, 0, domain), domain)
    energy = agent.energy
    params = jax.jit(agent.init)(jax.random.key(0)).params

    def encode_one(params: Params, context: Context, cache: PyTree) -> PyTree:
        if agent.encode_next is None:
            return energy.encode(params, context)
        return agent.encode_next(params, context, cache)

    encode = jax.vmap(encode_one, in_axes=(None, 0, 0))
    tokens = config.training.batch * config.planner.horizon
    peak = matmul_peak(tokens, config.model.width, seconds)
    rows: list[Row] = []
    for batch in batches:
        plan = compile_planner(
            energy, config.planner, (batch,), encode_next=agent.encode_next
        ).plan_next
        contexts = jax.device_put(random_contexts(domain, config.context, batch))
        keys = jax.random.split(jax.random.key(1), batch)
        begun = time.perf_counter()
        _, cache = plan(params, keys, contexts, None)
        first = time.perf_counter() - begun
        anew = planning = fastest(partial(plan, params, keys, contexts, None), seconds)
        if cache is not None:  # play reuses cached states
            plan(params, keys, contexts, cache)
            planning = fastest(partial(plan, params, keys, contexts, cache), seconds)
        # On as many devices as the planner.
        mesh = sharding.make_mesh(batch)
        split = sharding.split_batches(lambda _, *given: encode(*given), mesh)
        placed = jax.device_put((contexts, cache), NamedSharding(mesh, sharding.SPLIT))
        encoding = partial(split, None, sharding.replicate(params, mesh), *placed)
        jax.block_until_ready(encoding())
        rows.append(
            {
                "level": config.level,
                "preset": config.preset,
                "batch": batch,
                "compile_seconds": first - anew,
                "planning_seconds": planning,
                "anew_seconds": anew,  # without cached states
                "encoding_seconds": fastest(encoding, seconds),
                "playing_seconds": playing_seconds(domain, batch),
                "encoding_flops": matmul_flops(encode, params, contexts, cache),
                "peak_gflops": peak,
            }
        )
    return rows


def playing_seconds(domain: Domain, batch: int) -> float:
    """Measures the emulator's seconds for one decision in each of several games."""
    with contextlib.ExitStack() as stack:
        adapters = [stack.enter_context(closing(domain.make_adapter())) for _ in range(batch)]
        for seed, adapter in enumerate(adapters):
            adapter.reset(seed)
        actions = np.random.default_rng(0).integers(domain.num_actions - 1, size=(DECISIONS, batch))
        begun = time.perf_counter()
        for decision in actions:
            for adapter, action in zip(adapters, decision, strict=True):
                assert isinstance(adapter, Eager)
                adapter.begin(int(action))
            for adapter, action in zip(adapters, decision, strict=True):
                adapter.step(int(action))
        return (time.perf_counter() - begun) / DECISIONS


def tables(rows: Sequence[Row]) -> tuple[Table, Table]:
    """Makes a table of decisions: milliseconds, and states encoded."""
    taken = Table("game", "preset", "games", "ms", "planner", "of it encoder", "emulator", "per s")
    encoded = Table("game", "preset", "games", "past anew", "states/s", "GFLOP/s", "of the peak")
    for row in rows:
        whole = row["planning_seconds"] + row["playing_seconds"]
        name = row["level"], row["preset"], str(row["batch"])
        spent = (whole, *(row[f"{part}_seconds"] for part in ("planning", "encoding", "playing")))
        milliseconds = (f"{1e3 * seconds:.1f}" for seconds in spent)
        taken.add_row(*name, *milliseconds, f"{row['batch'] / whole:.0f}")
        encoded.add_row(*name, f"{1e3 * row['anew_seconds']:.1f}", *describe_encoding(row))
    return taken, encoded


if __name__ == "__main__":
    sys.exit(main())
