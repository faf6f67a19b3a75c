"""How well a model predicts demonstrations: `python -m experiments.accuracy runs/NAME [...]`.

Prints how often the model's likeliest action is the demonstrator's, at each position of the plan,
given all actions before it. One column is for demonstrations that the model learned from. The other
is for new ones of the same demonstrator. A gap between the columns says that the network recognises
demonstrations where it should understand the level. A fall along the plan says that the end of a
plan is unreliable. (A model trained with `--masking all` never saw the actions before a position,
so its numbers say little.)
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from leapjax import pretrained
from leapjax.data import seeds, storage, windows
from leapjax.data.windows import Steps
from leapjax.domain import Domain
from leapjax.errors import UserError
from leapjax.pretrained import Origin, Pretrained
from leapjax.running import jax_setup, shell
from leapjax.running.limits import check_counts
from leapjax.types import Demonstration, Energy, Params, Window, mask_token

TOGETHER = 64  # windows scored at once


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure how well models predict demonstrations, those they learned from and new ones.

    Attributes:
        runs: Folders of runs.
        demos: Demonstrations of each kind, learned from or new.
        samples: Largest number of steps to predict from, for each kind.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    demos: int = 200
    samples: int = 2000


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints one table per run; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.accuracy", given)
    return shell.run_program("experiments.accuracy", given, lambda: report(options))


def report(options: Options) -> None:
    """Prints one table per run."""
    check_counts(options, "demos", "samples")
    if not options.runs:
        raise UserError("expected at least one folder of a run")
    for run in options.runs:
        specification = pretrained.read_specification(run)
        if specification.method != "leap":
            raise UserError(f"{run} is of method {specification.method}: only leap masks actions")
        if pretrained.make_domain(specification).demonstrations.collect is None:
            raise UserError(
                f"{run} is of {specification.level}, which nobody here demonstrates: there are no "
                "other demonstrations to compare with"
            )
    jax_setup.start()
    for run in options.runs:
        Console(markup=False).print(make_table(pretrained.load(run), options, run.name))


def load_learned(domain: Domain, origin: Origin, count: int) -> Sequence[Demonstration]:
    """Loads at most `count` of the demonstrations that a run learned from."""
    count = min(count, origin.demos)
    source = domain.demonstrations.source
    if source is not None:
        where = origin.demonstrations or source.default
        return source.load(where, origin.seed).demonstrations[:count]
    if origin.demonstrations is not None:
        return storage.load(origin.demonstrations, domain, count).demonstrations
    return _collect(domain, count, origin.seed)


def collect_others(domain: Domain, origin: Origin, count: int) -> Sequence[Demonstration]:
    """Collects at most `count` demonstrations with another training seed than the run's."""
    last = seeds.MAX_TRAINING_SEED - 1
    return _collect(domain, min(count, origin.demos), last - (origin.seed == last))


def _collect(domain: Domain, count: int, seed: int) -> Sequence[Demonstration]:
    collect = domain.demonstrations.collect
    assert collect is not None  # `report` has checked it; all BabyAI levels have a demonstrator
    return collect(count, seed, lambda done: None).demonstrations


def make_table(planner: Pretrained, options: Options, title: str) -> Table:
    """Tabulates the accuracy at each position, for both kinds of demonstrations."""
    specification = planner.specification
    domain, origin = pretrained.make_domain(specification), specification.origin
    kinds = (
        load_learned(domain, origin, options.demos),
        collect_others(domain, origin, options.demos),
    )
    columns = [count_hits(planner, data, options.samples) for data in kinds]
    table = Table("position in the plan", "learned from", "others", title=title)
    for position in range(specification.planner.horizon):
        shares = (_format_share(right[position], asked[position]) for right, asked in columns)
        table.add_row(str(position + 1), *shares)
    table.add_section()
    table.add_row("all", *(_format_share(right.sum(), asked.sum()) for right, asked in columns))
    return table


def _format_share(right: int, asked: int) -> str:
    return f"{right / asked:.1%}" if asked else "-"


def count_hits(
    planner: Pretrained, data: Sequence[Demonstration], samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Counts the correct predictions, and all predictions, at each position: `[T]` each.

    Args:
        planner: the model.
        data: demonstrations.
        samples: largest number of steps to predict from, evenly spaced.
    """
    specification, end = planner.specification, planner.energy.num_actions - 1
    steps = jax.tree.map(jnp.asarray, windows.concatenate(data))
    count = steps.actions.shape[0]
    starts = jnp.asarray(np.linspace(0, count - 1, min(samples, count)).astype(np.int32))

    @jax.jit
    def score(params: Params, steps: Steps) -> tuple[jax.Array, jax.Array]:
        def one(start: jax.Array) -> tuple[jax.Array, jax.Array]:
            horizon = specification.planner.horizon
            window = windows.window(steps, start, specification.context, horizon, end)
            return find_hits(planner.energy, params, window, specification.method_settings.end)

        right, asked = jax.lax.map(one, starts, batch_size=TOGETHER)
        return right.sum(axis=0), asked.sum(axis=0)

    right, asked = jax.device_get(score(planner.params, steps))
    return right, asked


def find_hits(
    energy: Energy, params: Params, window: Window, end: bool
) -> tuple[jax.Array, jax.Array]:
    """Tells at which positions the model's likeliest action is the demonstrator's.

    Each action is predicted from the actions before it; MASK stands at and after its position.
    Positions after the first end action repeat it, so they do not count.

    Args:
        energy: energy of a masked model.
        params: its parameters.
        window: window of a demonstration.
        end: whether the first end action counts.

    Returns:
        `[T]` bool, where a prediction counts and is correct; `[T]` bool, where it counts.
    """
    memory = energy.encode(params, window.context)
    places = jnp.arange(window.actions.shape[0])
    ended = window.actions == energy.num_actions - 1
    counts = jnp.cumsum(ended) - (ended if end else 0) == 0  # up to the first end action

    def hit(place: jax.Array) -> jax.Array:
        tokens = jnp.where(places < place, window.actions, mask_token(energy.num_actions))
        energies = energy.conditional(params, memory, tokens, place[None])[0]
        return jnp.argmin(energies) == window.actions[place]

    return jax.vmap(hit)(places) & counts, counts


if __name__ == "__main__":
    sys.exit(main())
