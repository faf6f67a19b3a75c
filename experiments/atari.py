"""Atari (paper, table 2): `python -m experiments.atari --game Breakout --help`.

Plays games with built-in demonstrators where there are no data yet, trains a method on them, and
reports its score beside the paper's. `python -m experiments.atari collect --help` makes data
alone.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from experiments.atari_animation import animate
from experiments.common import config, experiment, memory, program, results
from experiments.common.config import D, M, P, check_counts
from experiments.common.experiment import Experiment
from experiments.common.progress import Meter
from leapjax.atari.domain import FOLDER, LONGEST, Settings, data_name, make, preset
from leapjax.atari.games import find_game
from leapjax.errors import UserError

RECORDED = Path("results/atari-data.json")
SMALLEST_WORKER = 100 << 20  # bytes of a process that plays


@dataclasses.dataclass(frozen=True)
class Config(config.Config[M, D, P]):
    """Train a method on played games, then measure its score.

    Attributes:
        level: Game: Breakout, Qbert, Pong or Seaquest; "all" for all of them.
        demos: Games to learn from, at most; see `--transitions`.
        demonstrations: Folder of DQN-Replay's files to train on, in place of data/atari, where
            games of built-in demonstrators are made.
        episodes: Held-out games to measure the score on.
        test_seed: Seed of the first of these games.
        validation: Measure the score on validation games instead, to choose settings.
        play: Game to play instead of the one that the planner of a checkpoint was trained on.
        pretrained: Evaluate the planner that comes with the library for the game, instead of
            training.
    """

    level: Annotated[str, tyro.conf.arg(name="game")]


EXPERIMENT = Experiment("atari", "atari", animate=animate, iterations=False, config=Config)


@dataclasses.dataclass(frozen=True)
class Collect:
    """Play games with built-in demonstrators; writes what DQN-Replay's files hold.

    Attributes:
        game: Game: Breakout, Qbert, Pong or Seaquest.
        transitions: Transitions to make at least, in whole games; None for as many as preset
            leapjax learns from.
        folder: Folder for the data; if games were begun there, they are continued.
        replay_run: Number of the run, as DQN-Replay has five of each game; each has games of its
            own.
        longest: Decisions after which a game is cut off, because a ball can fly on for ever.
        workers: Processes; None for one on each core.
        record: Write the scores of the demonstrators to results/, which is committed.
    """

    game: str
    transitions: int | None = None
    folder: Path = Path(FOLDER)
    replay_run: int = 1
    longest: int = LONGEST
    workers: int | None = None
    record: bool = False


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs every game and seed asked for, or collects data; the exit code."""
    given = program.arguments_of(arguments)
    if given[:1] == ["collect"]:
        options = program.parse(Collect, "experiments.atari collect", given[1:])
        return program.stoppable(f"experiments.{EXPERIMENT.name}", given, lambda _: run(options))
    return experiment.main(EXPERIMENT, given)


def run(options: Collect) -> None:
    """Makes data.

    Raises:
        UserError: an unknown game, numbers that cannot be, or data that are not to be recorded.
    """
    for name in ("transitions", "replay_run", "longest", "workers"):
        if getattr(options, name) is not None:
            check_counts(options, name)
    Settings(replay_run=options.replay_run, max_steps=options.longest)  # raises above their ranges
    memory.check({"--workers": (options.workers or 1) * SMALLEST_WORKER})
    if options.record and (options.replay_run, options.longest) != (1, LONGEST):
        raise UserError(
            f"--record is for data that are learned from: --replay-run 1, --longest {LONGEST}"
        )
    make(options.game, Settings())  # refuses an unknown game, and to go on without ale-py
    from leapjax.atari.collect import collect  # noqa: PLC0415  (ale-py is optional)

    console = Console(markup=False)
    transitions = options.transitions or preset(options.game, "leapjax")["transitions"]
    with Meter(console, "transitions", transitions) as meter:
        made = collect(
            options.folder, find_game(options.game), transitions, options.replay_run,
            options.longest, options.workers, meter.update,
        )  # fmt: skip
    games = [game for manifest in made for game in manifest["games"]]
    console.print(scores_table(games))
    if options.record:
        results.add(RECORDED, data_name(options.game, transitions), games)


def scores_table(games: Sequence[Mapping[str, Any]]) -> Table:
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
