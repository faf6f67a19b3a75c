"""Drawings of plans: `python -m experiments.qualitative --help`.

Draws the paper's two figures 'Qualitative Visualization'. The first shows plans of published
planners after N = 1, 5 and 10 iterations, and their execution. The second shows how models of
`experiments.properties` act in worlds that they were not trained in.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from rich.console import Console

from experiments import properties
from experiments.babyai_drawing import Colour, draw_picture, find_way, spell_actions
from experiments.common import cases
from experiments.common.cases import Way, Work
from experiments.common.episodes import watch_episode
from experiments.common.pictures import save_sheet
from leapjax import files, pretrained
from leapjax.data import seeds
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.constraints import find_half
from leapjax.domains.babyai.levels import find_level
from leapjax.domains.babyai.observations import Cell, agent_cell
from leapjax.environments import closing
from leapjax.errors import UserError
from leapjax.planners import GibbsConfig
from leapjax.pretrained import Pretrained
from leapjax.running import jax_setup, results, shell
from leapjax.running.interruption import Interruption
from leapjax.types import Plan

FIGURES = ("plans", "properties")
ITERATIONS = (1, 5, 10)
STEPS = 10  # length of the shortest episode that is drawn
HALVES = ((255, 80, 80), (80, 255, 255))  # frames of each model's obstacles: red, cyan
MOST_LEVELS, MOST_PLANS = 200, 30  # levels to search for an episode; plans to draw
# Levels of the first figure: planning a trajectory, and completing an instruction.
PLANNED = ("GoToObjMazeS4", "GoToSeqS5R2")
# Cases of the second figure, each with the way that is drawn.
ASKED = (
    ("adaptation-medium", "whole plan, exploring"),
    ("generalization-hard", "leap, exploring"),
    ("composition-easy", "sum, exploring"),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw plans and their execution.

    Attributes:
        seed: Training seed of the models of the second figure.
        test_seed: Level seed where the search for episodes begins. The first suitable episodes are
            drawn.
        record: Write the figures to docs/, which is committed.
        runs: Folder for trained models, and for figures that are not recorded.
    """

    seed: int = 0
    test_seed: int = seeds.UNSEEN
    record: bool = False
    runs: Path = Path("runs")


class Drawn(NamedTuple):
    """An episode: the iterations of its first plan, and the paths of all plans.

    Attributes:
        level_seed: seed of the level.
        trace: `[N, T]`, the first plan after each iteration.
        ways: cells that the agent visited, by plan.
        steps: length of the episode.
        outcome: "success", "failed", "gave up" or "not finished".
        adapter: level at the end of the episode.
    """

    level_seed: int
    trace: np.ndarray
    ways: Sequence[Sequence[Cell]]
    steps: int
    outcome: str
    adapter: BabyAIAdapter


def main(arguments: Sequence[str] | None = None) -> int:
    """Draws both figures; returns the exit code."""
    given = shell.read_arguments(arguments)
    options = shell.parse(Options, "experiments.qualitative", given)
    return shell.run_interruptible_program(
        "experiments.qualitative", given, lambda interruption: draw_figures(options, interruption)
    )


def draw_figures(options: Options, interruption: Interruption) -> None:
    """Draws both figures."""
    seeds.test_seeds(options.test_seed, MOST_LEVELS)
    seeds.training_seeds(options.seed)
    jax_setup.start()
    work = Work(
        properties.ANALYSIS,
        cases.Options(runs=options.runs),
        results.find_versions(),
        Console(markup=False),
        interruption,
    )
    folder = Path("docs") if options.record else options.runs
    for where in (folder, options.runs):  # fails before hours of work
        files.check_writable(where)
    refined = [each for level in PLANNED for each in draw_refinement(level, options.test_seed)]
    asked = [draw_unlearned(work, *names, options) for names in ASKED]
    sheets = (refined, 1 + len(ITERATIONS)), (asked, len(asked))
    for name, (pictures, columns) in zip(FIGURES, sheets, strict=True):
        path = folder / f"{name}.png"
        save_sheet(pictures, columns, path)
        work.console.print(f"wrote {path}", highlight=False)


def draw_refinement(level: str, first: int) -> list[Image.Image]:
    """Draws a published planner's plan after some iterations of algorithm 1, and its execution."""
    planner = pretrained.load(level)
    trained = planner.specification.planner
    assert isinstance(trained, GibbsConfig)  # as for all published planners
    search = dataclasses.replace(trained, iterations=max(ITERATIONS), fill="together", resampled=1)

    def plans_of(found: Drawn) -> tuple[BabyAIAdapter, list[list[Cell]]]:
        """Returns the level at its start, and the plan's path after each number of iterations."""
        with closing(BabyAIAdapter(find_level(level))) as start:
            start.reset(found.level_seed)
        return start, [find_way(start, found.trace[n - 1]) for n in ITERATIONS]

    def refined(found: Drawn) -> bool:
        return all(before != after for before, after in pairwise(plans_of(found)[1]))

    domain = cases.make_played_domain(level, [planner])
    asked = cases.make_planner(domain, Way("refined"), [planner], search)
    found = find_episode(level, asked, None, first, refined)
    start, ways = plans_of(found)
    plans = [
        draw_picture(start, f"N = {n}: {spell_actions(found.trace[n - 1])}", [way])
        for n, way in zip(ITERATIONS, ways, strict=True)
    ]
    return [*plans, draw_executed(found)]


def draw_unlearned(work: Work, case_name: str, way_name: str, options: Options) -> Image.Image:
    """Draws how models act in a world that they were not trained in."""
    (case,) = (case for case in properties.CASES if case.name == case_name)
    (way,) = (way for way in case.ways if way.name == way_name)
    models = cases.load_models(work, case, way.method, options.seed)
    search = way.search(models[0].specification.planner)
    planner = cases.make_planner(cases.make_played_domain(case.level, models), way, models, search)
    found = find_episode(case.level, planner, way.executed, options.test_seed)
    halves: list[tuple[list[Cell], Colour]] = []
    if case_name.startswith("composition"):  # each model sees a half of the obstacles
        state = found.adapter.observe()
        halves = [
            (
                [(x, y) for x, y in np.argwhere(find_half(state.grid, state.goal, part))],
                colour,
            )
            for part, colour in enumerate(HALVES)
        ]
    return draw_executed(found, case_name, halves)


def draw_executed(
    found: Drawn, name: str = "", marked: Sequence[tuple[Sequence[Cell], Colour]] = ()
) -> Image.Image:
    """Draws the paths of an episode's plans, each in its own colour."""
    plans = f"{len(found.ways)} plan{'s' * (len(found.ways) > 1)}"
    text = f"{name}{': ' * bool(name)}{plans}, {found.steps} steps, {found.outcome}"
    return draw_picture(found.adapter, text, found.ways, marked)


def find_episode(
    level: str,
    planner: Pretrained,
    limit: int | None,
    first: int,
    wanted: Callable[[Drawn], bool] = lambda found: True,
) -> Drawn:
    """Finds the first wanted episode of at least `STEPS` steps.

    Args:
        level: name of the level.
        planner: planner for the level.
        limit: executed actions of each plan; `None` for all.
        first: level seed where the search begins.
        wanted: whether to draw an episode.

    Raises:
        UserError: `MOST_LEVELS` levels have no such episode.
    """
    for level_seed in range(first, first + MOST_LEVELS):
        with closing(BabyAIAdapter(find_level(level))) as adapter:
            found = play_episode(adapter, planner, limit, level_seed)
        if found.steps >= STEPS and wanted(found):
            return found
    raise UserError(f"--test-seed {first}: none of {MOST_LEVELS} episodes is worth a drawing")


def play_episode(
    adapter: BabyAIAdapter, planner: Pretrained, limit: int | None, level_seed: int
) -> Drawn:
    """Plays one episode, and records its plans and paths."""
    traces: list[np.ndarray] = []
    ways: list[list[Cell]] = []
    steps, outcome = 0, "gave up"
    length = planner.specification.context
    for event in watch_episode(
        adapter, planner, length, level_seed, executed=limit, most=MOST_PLANS
    ):
        if isinstance(event, Plan):
            traces.append(np.asarray(event.trace[0]))
            ways.append([agent_cell(adapter.env)])
            continue
        _, transition = event
        ways[-1].append(agent_cell(adapter.env))
        over = transition.terminated or transition.truncated
        outcome = ("success" if transition.success else "failed") if over else "not finished"
        steps += 1
    return Drawn(level_seed, traces[0], ways, steps, outcome, adapter)


if __name__ == "__main__":
    sys.exit(main())
