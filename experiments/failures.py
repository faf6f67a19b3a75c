"""Which episodes fail, and why: `python -m experiments.failures runs/NAME [runs/NAME ...]`.

Plays validation levels (never test levels) with trained planners. Counts the failures by cause, by
the completed tasks of the instruction, and by the length of the detour that the level requires.
Draws some of them.
"""

import dataclasses
import enum
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from minigrid.envs.babyai.core.verifier import Instr, SeqInstr
from rich.console import Console
from rich.progress import track
from rich.table import Table

from experiments.babyai_drawing import draw_picture
from experiments.common.pictures import check_picture, save_sheet
from leapjax import pretrained, rollouts
from leapjax.checks import check_integer
from leapjax.data import seeds
from leapjax.domains.babyai import levels, observations
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.levels import Level
from leapjax.domains.babyai.observations import Cell, Observation
from leapjax.environments import Transition
from leapjax.errors import UserError
from leapjax.running import jax_setup, shell
from leapjax.running.limits import check_counts, check_executed

FEW_CELLS = 6  # an agent that stays within so many cells goes in circles
COLUMNS = 4  # of the gallery


class Cause(enum.Enum):
    """The cause of a failed episode: the first that applies."""

    GAVE_UP = "planned to stop before it was there"
    REFUSED = "did what ends the episode as a failure"
    HOLDS = "time ran out with an object in its hands"
    CIRCLES = f"time ran out going round within {FEW_CELLS} cells"
    WANDERS = "time ran out elsewhere"


@dataclasses.dataclass(frozen=True)
class Options:
    """Find out why episodes fail.

    Attributes:
        runs: Folders of runs of one level, for instance of several seeds.
        episodes: Validation episodes for each run.
        executed: Actions to execute before replanning, by default the whole plan.
        gallery: Path of the picture of failures, by default failures.png in the first run's folder.
        drawn: Largest number of failures in the picture.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    episodes: int = 500
    executed: int | None = None
    gallery: Path | None = None
    drawn: int = 8


class Recorder(BabyAIAdapter):
    """Records the detour of a level, the agent's cells and the last transition of an episode."""

    def __init__(self, level: Level) -> None:
        super().__init__(level)
        self.cells: list[Cell] = []
        self.detour: int | None = None
        self.last: Transition | None = None

    @property
    def tasks(self) -> list[bool]:
        """Lists whether each single task of the instruction is done by now."""
        return list_tasks_done(self.env.instrs)  # type: ignore[attr-defined]

    def reset(self, seed: int) -> Observation:
        """Starts the level of a seed."""
        observation = super().reset(seed)
        self.cells = [observations.agent_cell(self.env)]
        self.detour = measure_detour(self)
        return observation

    def step(self, action: int) -> Transition:
        """Takes an action of MiniGrid's first six."""
        self.last = super().step(action)
        self.cells.append(observations.agent_cell(self.env))
        return self.last


def main(arguments: Sequence[str] | None = None) -> int:
    """Reports the failures of some runs; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.failures", given)
    return shell.run_program("experiments.failures", given, lambda: report(options))


def report(options: Options) -> None:
    """Plays validation levels, prints the tables, draws the gallery."""
    check_counts(options, "episodes")
    check_integer("--drawn", options.drawn)
    console = Console(markup=False)
    played = seeds.validation_seeds(0, options.episodes)
    if options.gallery is not None:
        check_picture(options.gallery)
    level = find_common_level(options.runs, options.executed)
    jax_setup.start()
    recorders: list[Recorder] = []
    successes: list[bool] = []
    for run in track(options.runs, "playing", console=console):
        found, good = play(run, level, played, options.executed)
        recorders += found
        successes += good
    failed = [r for r, good in zip(recorders, successes, strict=True) if not good]
    console.print(f"{level.name}: {len(failed)} of {len(recorders)} episodes failed")
    console.print(make_cause_table(failed))
    if any(len(recorder.tasks) > 1 for recorder in recorders):
        console.print(make_task_table(recorders, failed))
    console.print(make_detour_table(recorders, failed))
    if failed and options.drawn > 0:
        path = options.gallery or options.runs[0] / "failures.png"
        draw_gallery(failed[: options.drawn], path)
        console.print(f"gallery: {path}", highlight=False)


def find_common_level(runs: Sequence[Path], executed: int | None) -> Level:
    """Returns the level that all runs share.

    Raises:
        UserError: there is no run, a run cannot be read, its plans have fewer actions than
            `executed`, or the runs have different levels.
    """
    names = set()
    for run in runs:
        specification = pretrained.read_specification(run)
        check_executed(executed, specification.planner.horizon, f" of {run}")
        names.add(specification.level)
    if len(names) != 1:
        raise UserError(f"expected runs of one level, got {', '.join(sorted(names)) or 'none'}")
    return levels.find_level(names.pop())


def play(
    run: Path, level: Level, played: range, executed: int | None
) -> tuple[list[Recorder], list[bool]]:
    """Plays the levels with one planner; returns the episodes, and whether each succeeded."""
    planner = pretrained.load(run)
    recorders: list[Recorder] = []

    def make_adapter() -> Recorder:
        recorders.append(Recorder(level))
        return recorders[-1]

    episodes = rollouts.evaluate(
        make_adapter, played, planner.plan, planner.params,
        context=planner.specification.context, executed=executed,
    )  # fmt: skip
    return recorders, episodes.successes.tolist()


def measure_detour(adapter: BabyAIAdapter) -> int | None:
    """Counts the cells by which the shortest free path to the goal exceeds a straight path.

    Returns `None` if there is no goal, or no free path to it.
    """
    start, goal = observations.agent_cell(adapter.env), adapter.goal
    if goal == observations.NO_GOAL:
        return None
    length = observations.path_lengths(adapter.env.grid, start, through_objects=False).get(goal)
    if length is None:
        return None
    return length - abs(start[0] - goal[0]) - abs(start[1] - goal[1])


def find_cause(recorder: Recorder) -> Cause:
    """Finds the cause of a failed episode."""
    last, cells = recorder.last, recorder.cells
    if last is not None and last.terminated:
        return Cause.REFUSED
    if last is None or not last.truncated:
        return Cause.GAVE_UP
    if recorder.env.carrying is not None:
        return Cause.HOLDS
    return Cause.CIRCLES if len(set(cells[len(cells) // 2 :])) <= FEW_CELLS else Cause.WANDERS


def list_tasks_done(instruction: Instr) -> list[bool]:
    """Lists whether each single task of an instruction is done, in the instruction's order.

    A task that is the whole instruction never counts as done: its success ends the episode.
    """

    def visit(part: Instr, done: bool) -> list[bool]:
        if not isinstance(part, SeqInstr):
            return [done]
        first, second = (getattr(part, name) == "success" for name in ("a_done", "b_done"))
        return [*visit(part.instr_a, done or first), *visit(part.instr_b, done or second)]

    return visit(instruction, False)


def make_cause_table(failed: Sequence[Recorder]) -> Table:
    """Tabulates the failures by cause."""
    counts = Counter(find_cause(recorder) for recorder in failed)
    result = Table("what happened", "episodes")
    for each in Cause:
        if counts[each]:
            result.add_row(each.value, str(counts[each]))
    return result


def make_task_table(played: Sequence[Recorder], failed: Sequence[Recorder]) -> Table:
    """Tabulates the failures by the instruction's number of tasks, and by how many were done."""
    totals = Counter(len(r.tasks) for r in played)
    failures = Counter((len(done), sum(done)) for done in (r.tasks for r in failed))
    result = Table("tasks of the instruction", "episodes", "failed, by how many were done")
    for count in sorted(totals):
        found = {done: n for (of, done), n in sorted(failures.items()) if of == count}
        share = sum(found.values()) / totals[count]
        details = ", ".join(f"{n} with {done} done" for done, n in found.items()) or "none"
        result.add_row(str(count), str(totals[count]), f"{share:.1%}: {details}")
    return result


def make_detour_table(played: Sequence[Recorder], failed: Sequence[Recorder]) -> Table:
    """Tabulates the failures by detour, see `measure_detour`."""
    totals, failures = (Counter(r.detour for r in some) for some in (played, failed))
    result = Table("detour (cells)", "episodes", "failed")
    for length in sorted(totals, key=lambda n: (n is None, n)):
        name = "no free way, or no goal" if length is None else str(length)
        share = failures[length] / totals[length]
        result.add_row(name, str(totals[length]), f"{failures[length]} ({share:.1%})")
    return result


def draw_gallery(failed: Sequence[Recorder], path: Path) -> None:
    """Draws the end of each episode, with the agent's whole path.

    Raises:
        UserError: the picture cannot be written.
    """
    pictures = [
        draw_picture(r, f"{len(r.cells) - 1} steps: {find_cause(r).value}", [r.cells])
        for r in failed
    ]
    save_sheet(pictures, COLUMNS, path)


if __name__ == "__main__":
    sys.exit(main())
