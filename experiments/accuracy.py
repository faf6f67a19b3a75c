"""What a trained model knows of demonstrations: `python -m experiments.accuracy runs/NAME [...]`.

How often the action that the model finds most likely is the demonstrator's, at each position of
the plan, given all actions before it: on demonstrations that it has learned from, and on others
of the same demonstrator. A gap between the two says that the network recognises demonstrations
where it should understand the level; a fall along the plan says that its end is not to be trusted.
(Not of a model that was trained with `--masking all`: it has seen no actions before others.)
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

TOGETHER = 64  # windows scored in one go


@dataclasses.dataclass(frozen=True)
class Options:
    """Say what models know of demonstrations that they have, and have not, learned from.

    Attributes:
        runs: Folders of runs.
        demos: Demonstrations of each kind, learned from or not.
        samples: Steps of the demonstrations to predict the actions of, at most.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    demos: int = 200
    samples: int = 2000


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints one table per run; the exit code."""
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
    """Some demonstrations that a run has learned from."""
    count = min(count, origin.demos)
    source = domain.demonstrations.source
    if source is not None:
        where = origin.demonstrations or source.default
        return source.load(where, origin.seed).demonstrations[:count]
    if origin.demonstrations is not None:
        return storage.load(origin.demonstrations, domain, count).demonstrations
    return _collect(domain, count, origin.seed)


def collect_others(domain: Domain, origin: Origin, count: int) -> Sequence[Demonstration]:
    """As many of the domain's demonstrator, of another training seed."""
    last = seeds.MAX_TRAINING_SEED - 1
    return _collect(domain, min(count, origin.demos), last - (origin.seed == last))


def _collect(domain: Domain, count: int, seed: int) -> Sequence[Demonstration]:
    collect = domain.demonstrations.collect
    assert collect is not None  # see `report`; all levels of BabyAI have a demonstrator
    return collect(count, seed, lambda done: None).demonstrations


def make_table(planner: Pretrained, options: Options, title: str) -> Table:
    """Accuracy by position, of both kinds of demonstrations."""
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
    """How many actions the model finds most likely, of how many: `[T]` each, by position.

    Args:
        planner: the model.
        data: demonstrations.
        samples: how many of their steps to predict from, evenly spaced.
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
    """Whether each action is the likeliest, given those before it and MASK after it.

    After the end action there is nothing to predict but more of it: those do not count.

    Args:
        energy: of a model that was trained to fill in what is masked.
        params: of it.
        window: of a demonstration.
        end: the end action is predicted, too.

    Returns:
        `[T]` bool: it is, and it counts; `[T]` bool: it counts.
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
