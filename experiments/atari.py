"""Atari (paper, table 2): `python -m experiments.atari --game Breakout --help`.

Plays games with built-in demonstrators where there are no data yet, trains a method on them, and
reports its score beside the paper's. `python -m experiments.atari collect --help` makes data
alone.
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
SMALLEST_WORKER = 100 << 20  # bytes of a process that plays


EXPERIMENT = Experiment("atari", "atari", animate=animate, iterations=False, config=AtariConfig)


@dataclasses.dataclass(frozen=True)
class Collect:
    """Play games with built-in demonstrators; writes what DQN-Replay's files hold.

    Attributes:
        game: Game: Breakout, Qbert, Pong or Seaquest.
        transitions: Transitions to make at least, in whole games; None for as many as preset
            leapjax learns from.
        folder: Folder for the data; if games were begun there, they are continued.
        dqn_seed: Number of the data, from 1, as DQN-Replay has the games of DQNs of five seeds;
            each has games of its own.
        longest: Decisions after which a game is cut off, because a ball can fly on for ever.
        workers: Processes; None for one on each core.
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
    """Runs every game and seed asked for, or collects data; the exit code."""
    given = shell.read_arguments(arguments)
    if given[:1] == ["collect"]:
        options = shell.parse(Collect, "experiments.atari collect", given[1:])
        return shell.run_interruptible_program(
            f"experiments.{EXPERIMENT.name}", given, lambda _: collect_games(options)
        )
    return running.main(EXPERIMENT, given)


def collect_games(options: Collect) -> None:
    """Makes data.

    Raises:
        UserError: an unknown game, numbers that cannot be, or data that are not to be recorded.
    """
    for name in ("transitions", "dqn_seed", "longest", "workers"):
        if getattr(options, name) is not None:
            check_counts(options, name)
    Settings(dqn_seed=options.dqn_seed, max_steps=options.longest)  # raises above their ranges
    memory.check({"--workers": (options.workers or 1) * SMALLEST_WORKER})
    if options.record and (options.dqn_seed, options.longest) != (1, LONGEST):
        raise UserError(
            f"--record is for data that are learned from: --dqn-seed 1, --longest {LONGEST}"
        )
    make(options.game, Settings())  # refuses an unknown game, and to go on without ale-py
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
    """Returns what data of a game are recorded as: its name, where there are as many as usual."""
    usual = transitions == presets.transitions(game)
    return game if usual else f"{game}, {transitions:,} transitions"


def parse_game(name: str) -> str:
    """Returns the game of data that `name_data` calls so."""
    return name.partition(",")[0]


def make_scores_table(games: Sequence[Mapping[str, Any]]) -> Table:
    """What demonstrators have reached, by how often they act at random."""
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
