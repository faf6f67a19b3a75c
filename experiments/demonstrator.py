"""Steps of the demonstrating bot on BabyAI's test levels: `python -m experiments.demonstrator`.

Plays every level that the planner of all levels learned, and those that it never learned.
"""

import dataclasses
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from leapjax.data import seeds
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.demonstrations import FAILED, demonstrate
from leapjax.domains.babyai.levels import Level, find_level, list_played
from leapjax.environments import closing
from leapjax.running import results, shell
from leapjax.running.limits import check_counts

RESULTS = Path("demonstrator.json")


@dataclasses.dataclass(frozen=True)
class Options:
    """Play BabyAI levels with the bot that demonstrates them.

    Attributes:
        level: Names or ids of levels, by default all that the planner of all levels plays.
        episodes: Test levels of each.
        record: Write the result to results/, which is committed.
        runs: Folder for a result that is not recorded.
    """

    level: tuple[str, ...] = ()
    episodes: int = 200
    record: bool = False
    runs: Path = Path("runs")


def main(arguments: Sequence[str] | None = None) -> int:
    """Plays every chosen level; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.demonstrator", given)
    return shell.run_program("experiments.demonstrator", given, lambda: play_all(options))


def play_all(options: Options) -> None:
    """Plays the levels, writes the file after each, and prints a table."""
    check_counts(options, "episodes")
    played = seeds.test_seeds(seeds.UNSEEN, options.episodes)
    names = options.level or list_played(find_level("BabyAI"))
    levels = [find_level(name) for name in names]
    path = results.choose_folder(options.record, options.runs) / RESULTS
    console = Console(markup=False)
    table = Table("level", "solved", "steps")
    for level in levels:
        each = play(level, played)
        results.add(path, level.name, each)
        steps = each["mean_success_length"]
        shown = (
            f"{each['successes'] / each['episodes']:.1%}",
            "-" if steps is None else f"{steps:.1f}",
        )
        console.print(f"{level.name}: {shown[0]}, {shown[1]} steps")
        table.add_row(level.name, *shown)
    console.print(table)


def play(level: Level, played: Sequence[int]) -> dict[str, Any]:
    """Plays the levels of some seeds; returns successes, and mean steps of the demonstrations."""
    dropped: Counter[str] = Counter()
    with closing(BabyAIAdapter(level)) as adapter:
        found = [demonstrate(adapter, seed, dropped) for seed in played]
    lengths = [len(each.actions) for each in found if each is not None]
    return {
        "episodes": len(played),
        "successes": len(played) - dropped[FAILED],  # episodes that end at another match count, too
        "mean_success_length": float(np.mean(lengths)) if lengths else None,
    }


if __name__ == "__main__":
    sys.exit(main())
