"""Satisfiability: `python -m experiments.satisfiability --help`.

Trains a method to satisfy unseen formulas, then plans with the trained energy in every way. Reports
success against passes of the model, beside two classical solvers on the same formulas.
"""

import sys
from collections.abc import Sequence

from rich.console import Console

from experiments import satisfiability_solvers
from experiments.common.searches import list_searches
from leapjax.configuration import choose_episode_seeds
from leapjax.domains.puzzles.satisfiability.formulas import find_level
from leapjax.running import main as running
from leapjax.running import shell
from leapjax.running.command_line import parse
from leapjax.running.run import Experiment

EXPERIMENT = Experiment("satisfiability", "satisfiability", list_searches)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every level and seed asked for; the exit code."""
    given = shell.read_arguments(arguments)
    failed = running.main(EXPERIMENT, given)
    if not failed:
        configs = parse(EXPERIMENT.domain, given, EXPERIMENT.config, EXPERIMENT.module)
        played = {config.play or config.level: choose_episode_seeds(config) for config in configs}
        for level, seeds in played.items():
            Console().print(f"{level}, solvers that learn nothing:", markup=False)
            Console().print(satisfiability_solvers.compare(find_level(level), seeds))
    return failed


if __name__ == "__main__":
    sys.exit(main())
