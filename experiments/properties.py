"""Properties of planning by energy (paper, section 6): `python -m experiments.properties --help`.

Tests constraints that training never saw, levels larger than in training, and sums of models that
each know a part of the task. Beyond the paper, it tests several constraints at once.
"""

import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from minigrid.core.world_object import WorldObj

from experiments.augmentation import augment
from experiments.common import cases
from experiments.common.cases import Analysis, Case, Model, Way, alone, draw_at
from leapjax.configuration import AnyConfig, change
from leapjax.domains.babyai.adapter import ACTIONS, TURNS, BabyAIAdapter
from leapjax.domains.babyai.constraints import (
    count_revisits,
    goal_before_visit,
    hide_half_of_obstacles,
    hide_lava,
    hide_marks,
    hide_open_doors,
    immediate_lava,
    lava,
    left_turns,
    replace_pick_up,
    steps_to_visit,
    turns_over,
)
from leapjax.domains.babyai.levels import find_level
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.symmetries import LEFT
from leapjax.energy import compose, constrain, neutral, view
from leapjax.environments import Transition
from leapjax.planners import BeamConfig, GibbsConfig
from leapjax.types import Context, Energy

Penalty = Callable[[Context, jax.Array], jax.Array]
Minimise = Callable[[Sequence[Energy]], Energy]  # see `Way`
# Turns that suffice to visit a cell of a room and then face an object: without other objects in the
# room, and with six.
FEW_TURNS, DETOUR_TURNS = 5, 9
WEIGHT = 20.0  # nats for a violation, or for a step to go: more than any detour costs
LIGHT = 5.0  # the same for beam search: with more, all beams stop at the place nearest to the cell
AGAIN = 16.0  # nats for each earlier visit to a pose of the plan
PICKUP = ACTIONS.index("pickup")


def train_longer(config: AnyConfig) -> AnyConfig:
    """Trains every method for 3,000 steps, because augmentation gives some more to learn."""
    return change(config, training={"steps": 3000})


def add_false_starts(config: AnyConfig) -> AnyConfig:
    """Shows LEAP how to go on after beginnings that constraints force and no demonstration has.

    The other methods plan one action, so their plans have no beginning to go on from.
    """
    return augment(config, false_starts=0.6) if config.method == "leap" else config


def add_detours(config: AnyConfig) -> AnyConfig:
    """Shows LEAP and DT paths around obstacles, which demonstrations of empty rooms never have.

    IQL learns from single steps, and a detour takes several.
    """
    if config.method not in ("leap", "dt"):
        return config
    return augment(config, detours=0.5, lookalikes=True)


def learn_in_room(config: AnyConfig) -> AnyConfig:
    """Configures training in an empty room for levels with obstacles and constraints."""
    return train_longer(add_detours(add_false_starts(config)))


def learn_in_maze(config: AnyConfig) -> AnyConfig:
    """Configures training in a maze for levels with constraints."""
    return train_longer(add_false_starts(config))


def learn_among_objects(config: AnyConfig) -> AnyConfig:
    """Configures training among objects; LEAP plans ten actions, as detours around them need."""
    found = learn_in_maze(config)
    if config.method != "leap":
        return found
    return change(found, planner={"horizon": 10, "iterations": 10})


def learn_for_maze(config: AnyConfig, sweeps: int) -> AnyConfig:
    """Configures training in a room for a maze whose paths have up to `sweeps` steps."""
    changed = change(config, domain_settings={"sweeps": sweeps}, training={"steps": 2000})
    return add_detours(changed)


def learn_long_distances(config: AnyConfig) -> AnyConfig:
    """Configures distances as long as the paths in a maze."""
    return change(config, domain_settings={"sweeps": 40})


class Watched(BabyAIAdapter):
    """Counts steps onto lava."""

    def __init__(self, level: str) -> None:
        super().__init__(find_level(level))
        self.violations = 0

    def step(self, action: int) -> Transition:
        """Takes an action of MiniGrid's first six."""
        transition = super().step(action)
        stands_on = self.env.grid.get(*self.env.agent_pos)
        self.violations += stands_on is not None and stands_on.type == "lava"
        return transition


class WatchedTurns(Watched):
    """Counts steps onto lava, and turns to the left."""

    def step(self, action: int) -> Transition:
        """Takes an action of MiniGrid's first six."""
        self.violations += action == LEFT
        return super().step(action)


class WatchedErrand(Watched):
    """Requires a visit to the coloured cell; counts goals before it, and turns beyond a budget."""

    def __init__(self, level: str, budget: int) -> None:
        super().__init__(level)
        self._budget = budget

    def reset(self, seed: int) -> Observation:
        """Starts the level of a seed."""
        self._turns = 0
        return super().reset(seed)

    def step(self, action: int) -> Transition:
        """Takes an action of MiniGrid's first six; a visit makes the coloured cell an empty one."""
        self._turns += action in TURNS
        self.violations += action in TURNS and self._turns > self._budget
        transition = super().step(action)
        x, y = self.env.agent_pos
        if _is_marked(self.env.grid.get(x, y)):
            self.env.grid.set(x, y, None)
        early = transition.success and any(map(_is_marked, self.env.grid.grid))
        self.violations += early
        return transition._replace(success=transition.success and not early)


def _is_marked(cell: WorldObj | None) -> bool:
    return cell is not None and cell.type == "floor"


def penalise_unseen(*penalties: Penalty, weight: float = WEIGHT) -> Minimise:
    """Adds penalties to a model, and hides lava and coloured cells from the model."""
    return functools.partial(_penalised, penalties=penalties, weight=weight)


def _penalised(energies: Sequence[Energy], penalties: Sequence[Penalty], weight: float) -> Energy:
    def penalty(context: Context, actions: jax.Array) -> jax.Array:
        count = sum((each(context, actions) for each in penalties), jnp.zeros(()))
        return jnp.where(count > 0, weight * count, 0.0)  # avoids inf * 0

    def hide_obstacles(context: Context) -> Context:
        return hide_marks(hide_lava(context))

    return constrain(view(energies[0], hide_obstacles), penalty, partial=True)


# Forbids violations. A penalty of the next action alone removes the actions that violate it.
masked = functools.partial(penalise_unseen, weight=math.inf)


def penalise_revisits(minimise: Minimise, handling: bool = False) -> Minimise:
    """Adds a penalty for each earlier visit to a pose of the plan, see `count_revisits`."""
    return functools.partial(_explored, minimise=minimise, nats=AGAIN, handling=handling)


def _explored(
    energies: Sequence[Energy], minimise: Minimise, nats: float, handling: bool
) -> Energy:
    def penalty(context: Context, actions: jax.Array) -> jax.Array:
        return nats * count_revisits(context, actions, handling)

    return constrain(minimise(energies), penalty, partial=True)


def fill_left_to_right(trained: GibbsConfig) -> GibbsConfig:
    """Fills a plan from left to right, so that a constraint can judge its beginning."""
    return dataclasses.replace(trained, fill="sequential", iterations=trained.horizon, resampled=1)


def search_beams(trained: GibbsConfig) -> BeamConfig:
    """Keeps 16 beginnings of a plan, because the way to the goal may first lead away from it."""
    return BeamConfig(horizon=trained.horizon, beams=16)


# If models disagree, the likeliest plan leads nowhere; noise leads out of such states.
noisily = draw_at(2.0)
# If the likeliest action is forbidden, the next likeliest leads to and fro; noise breaks this up.
wandering = draw_at(5.0)


def refine_plan(trained: GibbsConfig, rounds: int = 3) -> GibbsConfig:
    """Fills a plan from left to right, then resamples it: later actions inform earlier ones."""
    filled = fill_left_to_right(trained)
    return dataclasses.replace(filled, iterations=rounds * filled.iterations)


def refine_once(trained: GibbsConfig) -> GibbsConfig:
    """Fills a plan from left to right, then makes T Gibbs steps at temperature 1, for detours."""
    return dataclasses.replace(refine_plan(trained, rounds=2), temperature=1.0)


def halves(energies: Sequence[Energy], weights: Sequence[float] | None = None) -> Energy:
    """Adds two models; each sees one half of the obstacles."""
    views = (functools.partial(hide_half_of_obstacles, part=part) for part in (0, 1))
    return compose([view(e, see) for e, see in zip(energies, views, strict=True)], weights)


def one_half(energies: Sequence[Energy]) -> Energy:
    """Weighs `halves` so that the first model decides alone."""
    return halves(energies, [1.0, 0.0])


def fetch(energies: Sequence[Energy], weights: Sequence[float] | None = None) -> Energy:
    """Adds a model that goes to objects, neutral about picking up, and a model that picks up."""
    go, pick_up = energies
    return compose([neutral(view(go, replace_pick_up), [PICKUP]), pick_up], weights)


def only_pick_up(energies: Sequence[Energy]) -> Energy:
    """Weighs `fetch` so that the second model decides alone."""
    return fetch(energies, [0.0, 1.0])


def _make_explorers(
    name: str,
    minimise: Minimise,
    at_once: Minimise | None = None,
    search: Callable[[GibbsConfig], GibbsConfig] = lambda trained: trained,
    handling: bool = False,
) -> list[Way]:
    """Makes a way of each method with a cost of revisits; LEAP executes three actions, or one.

    Args:
        name: LEAP's way without this cost.
        minimise: energy without this cost.
        at_once: energy for DT and IQL without this cost, by default `minimise`.
        search: LEAP's search when it executes three actions.
        handling: see `count_revisits`.
    """
    whole, single = (penalise_revisits(m, handling) for m in (minimise, at_once or minimise))
    each = f"{name}, exploring, replanned after each action"
    ways = [
        Way(f"{name}, exploring", minimise=whole, search=search, executed=3),
        Way(each, minimise=whole, search=refine_plan, executed=1),
    ]
    ways += [Way(f"{method}, exploring", method, single) for method in ("dt", "iql")]
    return [way._replace(remembers=True) for way in ways]


def _make_noisier(minimise: Minimise, temperature: float) -> list[Way]:
    """Makes ways of DT and IQL with the higher temperature that preset `paper` needs."""
    search = draw_at(temperature)
    return [Way(f"{name}, with more noise", name, minimise, search) for name in ("dt", "iql")]


def _make_adaptation(
    name: str, model: Model, level: str, paper: tuple[float, float, float]
) -> Case:
    leap, dt, iql = paper
    at_once = masked(immediate_lava)
    return Case(
        f"adaptation-{name}",
        [model],
        level,
        [
            Way("next action", minimise=at_once, search=wandering, executed=1, paper=leap),
            # Ours: the paper penalises only the next action.
            Way("whole plan", minimise=penalise_unseen(lava), search=fill_left_to_right),
            Way("dt", "dt", at_once, wandering, paper=dt),
            Way("iql", "iql", at_once, wandering, paper=iql),
            *_make_noisier(at_once, 12.0),
            *_make_explorers("whole plan", masked(lava), at_once, fill_left_to_right),
        ],
        Watched,
    )


def _make_constraints(name: str, model: Model, level: str) -> Case:
    both, never = masked(immediate_lava, left_turns), masked(lava, left_turns)
    told = penalise_unseen(lava, left_turns)
    return Case(
        f"constraints-{name}",
        [model],
        level,
        [
            Way("whole plan", minimise=told, search=refine_once, executed=3),
            Way("dt", "dt", both, wandering),
            Way("iql", "iql", both, wandering),
            *_make_noisier(both, 12.0),
            *_make_explorers("whole plan", never, both, fill_left_to_right),
            Way(
                "whole plan, exploring, beam search", minimise=penalise_revisits(never),
                search=search_beams, executed=3, remembers=True,
            ),
        ],
        WatchedTurns,
    )  # fmt: skip


def _make_errand(name: str, model: Model, level: str, budget: int) -> Case:
    few_turns = functools.partial(turns_over, budget=budget)
    at_once = masked(goal_before_visit, few_turns)
    told = penalise_unseen(steps_to_visit, few_turns)
    lightly = penalise_unseen(steps_to_visit, few_turns, weight=LIGHT)
    ways = [
        Way("whole plan", minimise=told, search=fill_left_to_right, executed=3),
        Way("whole plan, beam search", minimise=lightly, search=search_beams, executed=3),
        Way("dt", "dt", at_once, wandering),
        Way("iql", "iql", at_once, wandering),
        Way("dt, told how far", "dt", told),
        Way("iql, told how far", "iql", told),
    ]
    return Case(
        f"constraints-{name}",
        [model],
        level,
        [way._replace(remembers=True) for way in ways],
        functools.partial(WatchedErrand, budget=budget),
    )


def _make_plain(paper: tuple[float, float, float], minimise: Minimise = alone) -> list[Way]:
    leap, dt, iql = paper
    return [
        Way("leap", minimise=minimise, paper=leap),
        Way("leap, three actions of each plan", minimise=minimise, executed=3, paper=leap),
        Way("dt", "dt", minimise, paper=dt),
        Way("iql", "iql", minimise, paper=iql),
        Way("leap, with noise", minimise=minimise, search=draw_at(4.0), executed=1),
        Way("dt, with noise", "dt", minimise, draw_at(8.0)),
        Way("iql, with noise", "iql", minimise, draw_at(12.0)),
        *_make_explorers("leap", minimise),
    ]


def doors_as_empty(energies: Sequence[Energy]) -> Energy:
    """Shows open doors as empty cells to the model of a case."""
    return view(energies[0], hide_open_doors)


def _make_without_doors(paper: tuple[float, float, float]) -> list[Way]:
    """Makes the plain ways, and the same ways with open doors shown as empty cells.

    No demonstration shows that open doors are no obstacles.
    """
    views = _make_plain(paper, doors_as_empty)
    named = [way._replace(name=f"{way.name}, open doors seen as empty") for way in views]
    return [*_make_plain(paper), *named]


def _make_composed(
    minimise: Callable[[Sequence[Energy]], Energy], paper: tuple[float, float, float]
) -> list[Way]:
    leap, dt, iql = paper
    return [
        Way("sum", minimise=minimise, search=noisily, paper=leap),
        Way("dt", "dt", minimise, noisily, paper=dt),
        Way("iql", "iql", minimise, noisily, paper=iql),
        Way("sum, with more noise", minimise=minimise, search=draw_at(4.0), executed=1),
        *_make_noisier(minimise, 8.0),
    ]


MAZE, OBSTACLES = "GoToObjMazeS4", "GoToBehindObstacles"
ROOM, OPEN_MAZE = Model("GoToLocalS8N1", learn_in_room), Model(MAZE, learn_in_maze)
OBJECTS = Model("GoToLocalS8N7", learn_among_objects)
CASES = (
    _make_adaptation("easy", ROOM, "GoToLavaEasy", (92.0, 68.0, 90.5)),
    _make_adaptation("medium", ROOM, "GoToLavaMedium", (64.5, 20.0, 52.0)),
    _make_adaptation("hard", OPEN_MAZE, "GoToLavaHard", (54.5, 48.0, 44.0)),
    Case("generalization-easy", [ROOM], "GoToLocalS8N15", _make_plain((77.5, 36.0, 60.5))),
    # Distances are as long as the paths in the maze, not only as those in a room.
    Case(
        "generalization-medium",
        [Model("GoToLocalS7N1", functools.partial(learn_for_maze, sweeps=28))],
        "GoToObjMazeS4R2", _make_without_doors((64.0, 37.5, 57.5)),
    ),
    Case(
        "generalization-hard",
        [Model("GoToLocalS10N1", functools.partial(learn_for_maze, sweeps=40))],
        MAZE, _make_without_doors((61.0, 24.5, 65.5)),
    ),
    Case(
        "composition-easy", [Model(OBSTACLES, learn_in_room)] * 2, OBSTACLES,
        [
            *_make_composed(halves, (83.5, 58.0, 42.5)),
            Way("one half alone", minimise=one_half, search=noisily),
            *_make_explorers("sum", halves),
            Way(
                "sum, exploring, replanned after each action, not gone over",
                minimise=penalise_revisits(halves), search=fill_left_to_right, executed=1,
                remembers=True,
            ),
        ],
    ),
    Case(
        "composition-medium", [Model(MAZE), Model("PickUpLocalS10N1", learn_long_distances)],
        "PickUpObjMazeS4",
        [
            *_make_composed(fetch, (43.0, 15.5, 11.5)),
            Way("pick-up alone", minimise=only_pick_up, search=noisily),
            *_make_explorers("sum", fetch, handling=True),
        ],
    ),
    _make_constraints("room", ROOM, "GoToLavaMedium"),
    _make_constraints("maze", OPEN_MAZE, "GoToLavaHard"),
    _make_errand("errand", ROOM, "GoToVia", FEW_TURNS),
    _make_errand("detour", OBJECTS, "GoToViaDetour", DETOUR_TURNS),
)  # fmt: skip
ANALYSIS = Analysis("properties", CASES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the chosen cases; returns the exit code."""
    return cases.main(ANALYSIS, arguments)


if __name__ == "__main__":
    sys.exit(main())
