"""Puts trained planners into the library: `python -m experiments.publish runs/NAME ...`.

`leapjax.load` finds a published planner by the name of its level. Its files are committed.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from leapjax import pretrained
from leapjax.errors import UserError
from leapjax.running import jax_setup, shell


@dataclasses.dataclass(frozen=True)
class Options:
    """Publish trained planners, each for its level."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Publishes every run that the command line names; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.publish", given)
    return shell.run_program("experiments.publish", given, lambda: publish_runs(options.runs))


def publish_runs(runs: Sequence[Path]) -> None:
    """Publishes runs; of two runs on the same level, the later one stays.

    Raises:
        UserError: there are no runs, or a run cannot be read.
    """
    if not runs:
        raise UserError("no runs to publish: name their folders")
    targets = [pretrained.PUBLISHED / pretrained.read_specification(run).level for run in runs]
    jax_setup.start()
    for folder, target in zip(runs, targets, strict=True):
        pretrained.publish(folder, target)
        size = sum(path.stat().st_size for path in target.iterdir())
        print(f"{folder}: {target}, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    sys.exit(main())
