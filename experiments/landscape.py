"""Energies of good and bad plans over training: `python -m experiments.landscape --help`.

The paper's 'Energy Landscape Verification' (section 5, figure 6, right). Measures the energy of
demonstrations that the model never learned from, over training: as they are, and with a share of
their actions replaced at random. Also measures the energy of plans over the iterations that refine
them.
"""

import dataclasses
import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from experiments import accuracy
from experiments.common import figures
from leapjax import files
from leapjax.batching import compile_planner
from leapjax.configuration import change
from leapjax.data import seeds, windows
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig
from leapjax.presets import find_preset
from leapjax.pretrained import Pretrained
from leapjax.running import jax_setup, limits, results, shell
from leapjax.running.data import load_demonstrations
from leapjax.running.interruption import Interruption
from leapjax.running.limits import check_counts
from leapjax.running.metrics import read_metrics
from leapjax.running.programs import PLANS_TOGETHER
from leapjax.running.run import Experiment, Run, open_run
from leapjax.running.train import train
from leapjax.types import Context, Energy, Params, Window

CORRUPTED = (0, 25, 50, 75, 100)  # percent of a demonstration's actions replaced at random
EXPERIMENT = Experiment("landscape", "babyai")
RESULTS = Path("landscape.json")


@dataclasses.dataclass(frozen=True)
class Options:
    """Train, and track the energies of good and bad plans.

    Attributes:
        level: Level of BabyAI, by default the paper's.
        presets: Presets to train with: "paper", "leapjax" or both.
        seed: Training seed.
        trajectories: Number of demonstrations to score, and of contexts to plan for.
        steps: Training steps, by default the preset's.
        record: Write the result to results/, which is committed.
        runs: Folder for trained models, and for a result that is not recorded.
    """

    level: str = "GoToLocalS7N5"
    presets: tuple[str, ...] = ("paper", "leapjax")
    seed: int = 0
    trajectories: int = 200
    steps: int | None = None
    record: bool = False
    runs: Path = Path("runs")


def main(arguments: Sequence[str] | None = None) -> int:
    """Trains with each preset and reports the energies; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.landscape", given)
    return shell.run_interruptible_program(
        "experiments.landscape", given, lambda interruption: report(options, interruption)
    )


def report(options: Options, interruption: Interruption) -> None:
    """Trains with each preset, prints a table, and writes the file and the figure."""
    check_counts(options, "trajectories")
    if options.steps is not None:
        check_counts(options, "steps")
    if not options.presets:
        raise UserError("--presets: name at least one, such as leapjax")
    if options.record and options.steps is not None:
        raise UserError("--record: what is recorded is trained for the preset's number of --steps")
    folder = results.choose_folder(options.record, options.runs)
    files.check_writable(folder)
    console = Console(markup=False)
    wanted = []
    for preset in options.presets:
        config = find_preset("babyai", options.level, "leap", preset)
        if options.steps is not None:
            config = change(config, training={"steps": options.steps})
        # A run records energies of so many trajectories: another number makes another run.
        runs = options.runs / f"landscape-{options.trajectories}"
        config = dataclasses.replace(config, seeds=(options.seed,), runs=runs)
        limits.check(config)
        wanted.append(config)
    jax_setup.start()
    found = []
    for config in wanted:
        played = seeds.validation_seeds(0, options.trajectories)
        opened = open_run(
            EXPERIMENT, config, options.seed, console, interruption, played, plays=False
        )
        with opened as this:
            found.append(measure_landscape(this, options.trajectories))
    console.print(make_table(found))
    keep_measurements(folder / RESULTS, found)
    figures.draw_landscape(found, options.runs / "landscape.png")
    console.print(f"picture: {options.runs / 'landscape.png'}", highlight=False)


def keep_measurements(path: Path, found: Sequence[Mapping[str, Any]]) -> None:
    """Adds measurements to a file; they replace those with equal level, preset and seed."""

    def name(each: Mapping[str, Any]) -> tuple[Any, ...]:
        return each["level"], each["preset"], each["seed"]

    def changed(known: Sequence[Mapping[str, Any]] | None) -> list[Mapping[str, Any]]:
        return list({name(each): each for each in [*(known or []), *found]}.values())

    results.change(path, changed)


def measure_landscape(this: Run, count: int) -> dict[str, Any]:
    """Measures energies during one training, and energies of plans after it."""
    firsts = collect_beginnings(this, count)
    end = this.domain.num_actions - 1

    def measure(energy: Energy, params: Params) -> dict[str, float]:
        found = {n: compute_mean_energy(energy, params, firsts, n / 100, end) for n in CORRUPTED}
        return {f"random_{share}": float(mean) for share, mean in found.items()}

    planner = train(this, load_demonstrations(this), measure)
    last = measure(planner.energy, planner.params)
    curve = read_metrics(this.folder)
    watched = [{"step": m["step"], **{k: m[k] for k in last}} for m in curve]
    if not watched:  # the model was trained before, and its curve is gone
        watched = [{"step": this.config.training.steps, **last}]
    return {
        "level": this.config.level,
        "preset": this.config.preset,
        "seed": this.seed,
        "trajectories": count,
        "training": watched,
        "planning": measure_refinement(planner, firsts.context),
        "versions": results.find_versions(),
        "date": results.format_date(),
    }


def collect_beginnings(this: Run, count: int) -> Window:
    """Collects the first windows `[B]` of demonstrations with another training seed.

    Leaves out demonstrations shorter than a plan, because some models have no end action.

    Raises:
        UserError: all demonstrations are shorter than a plan.
    """
    domain, specification = this.domain, this.specification
    horizon = specification.planner.horizon
    data = accuracy.collect_others(domain, specification.origin, count)
    data = [each for each in data if len(each.actions) >= horizon]
    if not data:
        raise UserError(
            f"--trajectories {count}: none of these demonstrations has as many actions as a plan, "
            f"{horizon}: give more"
        )
    steps = jax.tree.map(jnp.asarray, windows.concatenate(data))
    end = domain.num_actions - 1
    return jax.vmap(
        lambda index: windows.window(steps, index, specification.context, horizon, end)
    )(steps.starts)


def corrupt_actions(key: jax.Array, actions: jax.Array, share: float, end: int) -> jax.Array:
    """Replaces each action of `[T]` with probability `share` by a random one.

    Never draws the end action, because a demonstration has it only after its last step.
    """
    where_key, action_key = jax.random.split(key)
    wrong = jax.random.uniform(where_key, actions.shape) < share
    return jnp.where(wrong, jax.random.randint(action_key, actions.shape, 0, end), actions)


@functools.partial(jax.jit, static_argnames=("energy", "end"))
def compute_mean_energy(
    energy: Energy, params: Params, begins: Window, share: float, end: int
) -> jax.Array:
    """Computes the mean energy `[]` of windows `[B]` with a share of their actions replaced."""

    def one(place: jax.Array, window: Window) -> jax.Array:
        actions = corrupt_actions(jax.random.key(place), window.actions, share, end)
        return energy.total(params, energy.encode(params, window.context), actions)

    return jax.vmap(one)(jnp.arange(len(begins.actions)), begins).mean()


def measure_refinement(planner: Pretrained, contexts: Context) -> dict[str, list[Any]]:
    """Plans, and returns the energies after each iteration: their mean, and eight single curves.

    Plans with N = 10, the paper's for the default level, or more if the preset does. The contexts
    are beginnings of demonstrations, so that the energies compare.
    """
    trained = planner.specification.planner
    assert isinstance(trained, GibbsConfig)  # as for every energy over plans of several actions
    config = dataclasses.replace(trained, iterations=max(10, trained.iterations), score_trace=True)
    plan = compile_planner(planner.energy, config, (PLANS_TOGETHER,))
    keys = jax.random.split(jax.random.key(0), len(jax.tree.leaves(contexts)[0]))
    plans = plan(planner.params, keys, contexts)
    energies = np.asarray(plans.trace_energies)  # [B, N]
    return {
        "mean": energies.mean(axis=0).tolist(),
        "single": energies[:8].tolist(),
    }


def make_table(found: Sequence[dict[str, Any]]) -> Table:
    """Tabulates the energies at the end of training for a terminal."""
    names = [f"{share}% random" for share in CORRUPTED]
    shown = Table("level", "preset", *names, "plans, N = 1", "last")
    for each in found:
        last, planned = each["training"][-1], each["planning"]["mean"]
        energies = (last[f"random_{share}"] for share in CORRUPTED)
        cells = (f"{value:.2f}" for value in (*energies, planned[0], planned[-1]))
        shown.add_row(each["level"], each["preset"], *cells)
    return shown


if __name__ == "__main__":
    sys.exit(main())
