"""Observations of a BabyAI level: the full state, and the goal fixed at reset.

All functions read MiniGrid's state without changing it. Shape letters, in addition to those in
`leapjax.types`: S is the side of the grid, L the number of tokens of an instruction.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from minigrid.core.constants import COLOR_TO_IDX, DIR_TO_VEC, OBJECT_TO_IDX
from minigrid.core.grid import Grid
from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel
from minigrid.envs.babyai.core.verifier import GoToInstr, OpenInstr, PickupInstr

from leapjax.errors import UserError
from leapjax.types import Array

NO_GOAL = (-1, -1)
Cell = tuple[int, int]


class Observation(NamedTuple):
    """One state of a grid world, as numbers. A position (x, y) is the cell `grid[x, y]`.

    Attributes:
        grid: object, colour and state of every cell, `[S, S, 3]` uint8; shows the agent too.
        pose: x, y and direction (0 right, 1 down, 2 left, 3 up), `[3]` int32.
        carried: object and colour that the agent carries, `[2]` int32; (0, 0) for empty hands.
        goal: x and y of the target, `[2]` int32; (-1, -1) if it is not observed.
        instruction: token ids `[L]` int32; 0 pads on the right.
    """

    grid: Array
    pose: Array
    carried: Array
    goal: Array
    instruction: Array


def blank(side: int, words: int) -> Observation:
    """Makes an observation of zeros with a level's shapes and types."""
    return Observation(
        np.zeros((side, side, 3), np.uint8),
        np.zeros(3, np.int32),
        np.zeros(2, np.int32),
        np.zeros(2, np.int32),
        np.zeros(words, np.int32),
    )


def observe(env: RoomGridLevel, side: int, goal: Cell, instruction: np.ndarray) -> Observation:
    """Reads the full state of a level as an `Observation` of NumPy arrays.

    Args:
        env: environment of a level, after its reset.
        side: S; smaller or non-square grids are padded at the far ends with zeros.
        goal: cell that `nearest_goal` found at reset.
        instruction: token ids `[L]`.

    Raises:
        UserError: the level is larger than S.
    """
    grid = np.zeros((side, side, 3), np.uint8)
    width, height = env.grid.width, env.grid.height
    if max(width, height) > side:
        raise UserError(f"the level is {width} by {height} cells, larger than the grid of {side}")
    grid[:width, :height] = env.grid.encode()
    x, y = map(int, env.agent_pos)
    grid[x, y] = OBJECT_TO_IDX["agent"], 0, env.agent_dir
    carried = env.carrying
    held = (OBJECT_TO_IDX[carried.type], COLOR_TO_IDX[carried.color]) if carried else (0, 0)
    return Observation(
        grid=grid,
        pose=np.array([x, y, env.agent_dir], np.int32),
        carried=np.array(held, np.int32),
        goal=np.array(goal, np.int32),
        instruction=instruction,
    )


def nearest_goal(env: RoomGridLevel) -> Cell:
    """Finds the target of an instruction: the matching object with the shortest path.

    Ties go to the smaller x, then the smaller y. Paths lead through open and closed doors. A match
    whose every path is blocked by objects comes after all others, ordered by its path through the
    objects.

    Returns `NO_GOAL` if the instruction has several targets, or if every match is outside the grid
    (such as a key in a closed box).
    """
    instruction = env.instrs  # type: ignore[attr-defined]
    if not isinstance(instruction, GoToInstr | OpenInstr | PickupInstr):
        return NO_GOAL
    matches = [(int(x), int(y)) for x, y in instruction.desc.obj_poss]
    if not matches:
        return NO_GOAL
    start = agent_cell(env)
    free = path_lengths(env.grid, start, through_objects=False)
    blocked = path_lengths(env.grid, start, through_objects=True)
    far = env.grid.width * env.grid.height

    def distance(cell: Cell) -> tuple[int, Cell]:
        return free.get(cell, far + blocked.get(cell, far)), cell

    return min(matches, key=distance)


def path_lengths(grid: Grid, start: Cell, through_objects: bool) -> dict[Cell, int]:
    """Counts the moves from `start` to every cell that can be reached, or touched, from it.

    Paths end at objects, which are reached but not passed, unless `through_objects`. Paths always
    end at walls, and pass doors and coloured floors.
    """
    lengths = {start: 0}
    queue = deque([start])
    while queue:
        x, y = cell = queue.popleft()
        content = grid.get(x, y)
        passable = content is None or content.type in ("door", "floor")
        passable |= through_objects and content is not None and content.type != "wall"
        if cell != start and not passable:
            continue
        for dx, dy in DIR_TO_VEC:
            near = (x + int(dx), y + int(dy))
            inside = 0 <= near[0] < grid.width and 0 <= near[1] < grid.height
            if inside and near not in lengths:
                lengths[near] = lengths[cell] + 1
                queue.append(near)
    return lengths


def agent_cell(env: RoomGridLevel) -> Cell:
    """Returns the agent's cell."""
    x, y = env.agent_pos
    return int(x), int(y)


def front_cell(env: RoomGridLevel) -> Cell:
    """Returns the cell that the agent faces."""
    x, y = env.front_pos
    return int(x), int(y)
