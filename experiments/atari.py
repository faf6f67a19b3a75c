"""Atari (paper, table 3): `python -m experiments.atari --game Breakout --help`.

Trains a method on played games, and reports its score beside the paper's. Built-in demonstrators
play the games if there are no data yet. `python -m experiments.atari collect --help` tells how to
make data without training.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from experiments.atari_animation import animate
from leapjax.domains.atari.domain import FOLDER, LONGEST, Settings, make
from leapjax.domains.atari.games import find_game
from leapjax.errors import UserError
from leapjax.presets import atari as presets
from leapjax.running import main as running
from leapjax.running import memory, results, shell
from leapjax.running.limits import check_counts
from leapjax.running.progress import Meter
from leapjax.running.run import Experiment
from leapjax.running.spelling import AtariConfig

RECORDED = Path("results/atari-data.json")
SMALLEST_WORKER = 100 << 20  # bytes of memory that a playing process needs at least


EXPERIMENT = Experiment("atari", "atari", animate=animate, iterations=False, config=AtariConfig)


@dataclasses.dataclass(frozen=True)
class Collect:
    """Play games with built-in demonstrators, and write them in the format of DQN-Replay.

    Attributes:
        game: Game: Breakout, Qbert, Pong or Seaquest.
        transitions: Least number of transitions, in whole games. By default as many as preset
            leapjax learns from.
        folder: Folder for the data; games begun there are continued.
        dqn_seed: Number of the data, from 1, like the five DQN seeds of DQN-Replay. Each number
            has its own games.
        longest: Decisions after which a game is cut off, because a ball can fly on for ever.
        workers: Number of processes, by default one for each core.
        record: Write the scores of the demonstrators to results/, which is committed.
    """

    game: str
    transitions: int | None = None
    folder: Path = Path(FOLDER)
    dqn_seed: int = 1
    longest: int = LONGEST
    workers: int | None = None
    record: bool = False


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every chosen game and seed, or collects data; returns the exit code."""
    given = shell.read_arguments(arguments)
    if given[:1] == ["collect"]:
        options = shell.parse(Collect, "experiments.atari collect", given[1:])
        return shell.run_interruptible_program(
            f"experiments.{EXPERIMENT.name}", given, lambda _: collect_games(options)
        )
    return running.main(EXPERIMENT, given)


def collect_games(options: Collect) -> None:
    """Plays games, stores them and prints a table of their scores.

    Raises:
        UserError: the game is unknown, a number is out of range, or `record` is set although runs
            do not learn from such data.
    """
    for name in ("transitions", "dqn_seed", "longest", "workers"):
        if getattr(options, name) is not None:
            check_counts(options, name)
    Settings(dqn_seed=options.dqn_seed, max_steps=options.longest)  # raises if it is out of range
    memory.check({"--workers": (options.workers or 1) * SMALLEST_WORKER})
    if options.record and (options.dqn_seed, options.longest) != (1, LONGEST):
        raise UserError(
            f"--record is for data that are learned from: --dqn-seed 1, --longest {LONGEST}"
        )
    make(options.game, Settings())  # raises if the game is unknown or ale-py is missing
    from leapjax.domains.atari.demonstrators.collect import collect  # noqa: PLC0415  (ale-py is optional)

    console = Console(markup=False)
    transitions = options.transitions or presets.transitions(options.game)
    with Meter(console, "transitions", transitions) as meter:
        made = collect(
            options.folder, find_game(options.game), transitions, options.dqn_seed,
            options.longest, options.workers, meter.update,
        )  # fmt: skip
    games = [game for manifest in made for game in manifest["games"]]
    console.print(make_scores_table(games))
    if options.record:
        results.add(RECORDED, name_data(options.game, transitions), games)


def name_data(game: str, transitions: int) -> str:
    """Names the data of a game: the game, and the number of transitions if it is unusual."""
    usual = transitions == presets.transitions(game)
    return game if usual else f"{game}, {transitions:,} transitions"


def parse_game(name: str) -> str:
    """Returns the game in a name that `name_data` made."""
    return name.partition(",")[0]


def make_scores_table(games: Sequence[Mapping[str, Any]]) -> Table:
    """Tabulates the demonstrators' scores by their share of random actions."""
    table = Table("random actions", "games", "transitions", "mean score", "least", "most")
    for noise in sorted({game["noise"] for game in games}):
        some = [game for game in games if game["noise"] == noise]
        scores = [game["score"] for game in some]
        table.add_row(
            f"{noise:.0%}",
            str(len(some)),
            str(sum(game["transitions"] for game in some)),
            f"{sum(scores) / len(scores):.1f}",
            f"{min(scores):g}",
            f"{max(scores):g}",
        )
    return table


if __name__ == "__main__":
    sys.exit(main())
