"""What energies training gives to good and bad plans: `python -m experiments.landscape --help`.

The paper's 'Energy Landscape Verification' (section 4, figure 6, right): the energy of
demonstrations that were never learned from, as they are and with a share of their actions replaced
at random, over training. Beside it, the energy of plans over the iterations that refine them.
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

CORRUPTED = (0, 25, 50, 75, 100)  # percent of a plan's actions that are random
EXPERIMENT = Experiment("landscape", "babyai")
RESULTS = Path("landscape.json")


@dataclasses.dataclass(frozen=True)
class Options:
    """Train, and watch the energies of good and bad plans.

    Attributes:
        level: Level of BabyAI; the paper's is the default.
        presets: Presets to train with, "paper" or "leapjax" or both.
        seed: Training seed.
        trajectories: Demonstrations to compute the energy of, and contexts to plan for.
        steps: Training steps; None for as many as the preset has.
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
    """Trains with each preset and says what was found; the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.landscape", given)
    return shell.run_interruptible_program(
        "experiments.landscape", given, lambda interruption: report(options, interruption)
    )


def report(options: Options, interruption: Interruption) -> None:
    """Trains with each preset; the table, the file and the figure of what was found."""
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
        # What is watched is part of a run: one of another count is another run.
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
    """Adds what was found to a file, in the place of others of the same level, preset and seed."""

    def name(each: Mapping[str, Any]) -> tuple[Any, ...]:
        return each["level"], each["preset"], each["seed"]

    def changed(known: Sequence[Mapping[str, Any]] | None) -> list[Mapping[str, Any]]:
        return list({name(each): each for each in [*(known or []), *found]}.values())

    results.change(path, changed)


def measure_landscape(this: Run, count: int) -> dict[str, Any]:
    """One training, watched; and plans of what was learned."""
    firsts = collect_beginnings(this, count)
    end = this.domain.num_actions - 1

    def measure(energy: Energy, params: Params) -> dict[str, float]:
        found = {n: compute_mean_energy(energy, params, firsts, n / 100, end) for n in CORRUPTED}
        return {f"random_{share}": float(mean) for share, mean in found.items()}

    planner = train(this, load_demonstrations(this), measure)
    last = measure(planner.energy, planner.params)
    curve = read_metrics(this.folder)
    watched = [{"step": m["step"], **{k: m[k] for k in last}} for m in curve]
    if not watched:  # trained before, and its curve is gone
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
    """The beginnings `[B]` of demonstrations of another training seed.

    Of those that are as long as a plan: to some models the end of an episode is no action.

    Raises:
        UserError: none is.
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
    """Actions `[T]`, each random with a probability, but never the end action.

    Where a demonstration goes on, the end is not one of its actions.
    """
    where_key, action_key = jax.random.split(key)
    wrong = jax.random.uniform(where_key, actions.shape) < share
    return jnp.where(wrong, jax.random.randint(action_key, actions.shape, 0, end), actions)


@functools.partial(jax.jit, static_argnames=("energy", "end"))
def compute_mean_energy(
    energy: Energy, params: Params, begins: Window, share: float, end: int
) -> jax.Array:
    """The mean energy `[]` of what was done in windows `[B]`, a share of it replaced at random."""

    def one(place: jax.Array, window: Window) -> jax.Array:
        actions = corrupt_actions(jax.random.key(place), window.actions, share, end)
        return energy.total(params, energy.encode(params, window.context), actions)

    return jax.vmap(one)(jnp.arange(len(begins.actions)), begins).mean()


def measure_refinement(planner: Pretrained, contexts: Context) -> dict[str, list[Any]]:
    """The energy of plans after every iteration, with the paper's N: their mean, and some.

    Plans of what demonstrations began with, so that their energies compare.
    """
    trained = planner.specification.planner
    assert isinstance(trained, GibbsConfig)  # as of every energy over plans of several actions
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
    """Energies at the end of training, for a terminal."""
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
