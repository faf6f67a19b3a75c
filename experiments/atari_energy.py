"""Energies of good and bad games (paper, 'Energy vs. Reward'): `experiments.atari_energy --help`.

A trained LEAP (`--checkpoint runs/NAME`) scores the trajectories that it learned from. The program
compares the energy of each trajectory with its reward.
"""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from scipy import stats

from experiments.accuracy import load_learned
from experiments.common import figures
from leapjax import pretrained
from leapjax.data import windows
from leapjax.errors import UserError
from leapjax.pretrained import Pretrained
from leapjax.running import jax_setup, memory, results, shell
from leapjax.running.limits import check_counts, count_layer_bytes
from leapjax.types import Demonstration

RESULTS = Path("atari-energy.json")


@dataclasses.dataclass(frozen=True)
class Options:
    """Compare the energies of trajectories with their rewards.

    Attributes:
        checkpoint: Folders of runs of LEAP on Atari, one for each game.
        windows: Random windows to score in each trajectory.
        record: Write the result to results/, which is committed.
        runs: Folder for a result that is not recorded.
    """

    checkpoint: tuple[Path, ...]
    windows: int = 64
    record: bool = False
    runs: Path = Path("runs")


def main(arguments: Sequence[str] | None = None) -> int:
    """Reports how energy and reward are correlated; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.atari_energy", given)
    return shell.run_program("experiments.atari_energy", given, lambda: report(options))


def report(options: Options) -> None:
    """Prints the correlation of each game, and writes the file and the figure."""
    check_counts(options, "windows")
    if not options.checkpoint:
        raise UserError("--checkpoint: name the folder of at least one run")
    specifications = [pretrained.read_specification(path) for path in options.checkpoint]
    for path, specification in zip(options.checkpoint, specifications, strict=True):
        if (specification.domain, specification.method) != ("atari", "leap"):
            raise UserError(
                f"{path} is {specification.method} on {specification.level}, not LEAP on Atari"
            )
        # All windows of a trajectory are scored at once, each with T passes.
        horizon, model = specification.planner.horizon, specification.model
        layer = count_layer_bytes(model, specification.context + horizon)
        memory.check({"--windows": options.windows * horizon * layer})
    jax_setup.start()
    path = results.choose_folder(options.record, options.runs) / RESULTS
    console = Console(markup=False)
    for checkpoint in options.checkpoint:
        planner = pretrained.load(checkpoint)
        specification = planner.specification
        domain, origin = pretrained.make_domain(specification), specification.origin
        each = correlate(planner, load_learned(domain, origin, origin.demos), options.windows)
        found = results.add(path, specification.level, each)
        console.print(
            f"{specification.level}: rank correlation {each['correlation']:.2f} of energy "
            f"and reward (p = {each['p_value']:.2g}, {len(each['energies'])} trajectories)"
        )
    picture = options.runs / "atari-energy.png"
    figures.draw_energies(found, picture)
    console.print(f"picture: {picture}", highlight=False)


def correlate(planner: Pretrained, games: Sequence[Demonstration], count: int) -> dict[str, Any]:
    """Computes each trajectory's mean energy per action, its return, and their rank correlation.

    Raises:
        UserError: all trajectories have the same return.
    """
    specification = planner.specification
    horizon, end = specification.planner.horizon, planner.energy.num_actions - 1
    random = np.random.default_rng(specification.origin.seed)
    # Windows stay within their trajectory, because a game has no end action.
    games = [game for game in games if len(game.actions) >= horizon]

    @functools.partial(jax.jit, static_argnums=0)
    def energies(energy: Any, params: Any, steps: windows.Steps, places: jax.Array) -> jax.Array:
        def one(place: jax.Array) -> jax.Array:
            window = windows.window(steps, place, specification.context, horizon, end)
            memory = energy.encode(params, window.context)
            return energy.total(params, memory, window.actions) / horizon

        return jax.vmap(one)(places).mean()

    means, returns = [], []
    for game in games:
        places = random.integers(len(game.actions) - horizon + 1, size=count)
        steps = jax.tree.map(jnp.asarray, windows.concatenate([game], padded=True))
        means.append(float(energies(planner.energy, planner.params, steps, jnp.asarray(places))))
        returns.append(float(game.rewards.sum()))
    if len(set(returns)) < 2:
        raise UserError(
            f"all {len(returns)} trajectories of {specification.level} have one reward: there is "
            "nothing to compare energies with"
        )
    found = stats.spearmanr(means, returns)
    return {
        "energies": means,
        "returns": returns,
        "correlation": float(found.statistic),
        "p_value": float(found.pvalue),
        "horizon": horizon,
        "windows": count,
        "versions": results.find_versions(),
        "date": results.format_date(),
    }


if __name__ == "__main__":
    sys.exit(main())
