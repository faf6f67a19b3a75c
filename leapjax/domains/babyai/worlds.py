"""Levels of the paper's analyses (section 6) that MiniGrid does not have.

The paper describes them only briefly; details follow its authors' code.
"""

from minigrid.core.world_object import Ball, Box, Floor, Key, Lava
from minigrid.envs.babyai import GoTo, GoToLocal
from minigrid.envs.babyai.core.roomgrid_level import RejectSampling, RoomGridLevel
from minigrid.envs.babyai.core.verifier import GoToInstr, ObjDesc, PickupInstr

from leapjax.domains.babyai.observations import Cell, agent_cell, path_lengths

MOST_LAVA = 5  # most lava cells of GoToLavaMedium


def target_cell(env: RoomGridLevel) -> Cell:
    """Finds the cell of the object that the instruction names, while a level is being made."""
    described = env.instrs.desc  # type: ignore[attr-defined]
    described.find_matching_objs(env)
    x, y = described.obj_poss[0]
    return int(x), int(y)


def free_cells(env: RoomGridLevel, cells: list[Cell]) -> list[Cell]:
    """Returns the cells that hold neither an object nor the agent."""
    return [cell for cell in cells if env.grid.get(*cell) is None and cell != agent_cell(env)]


class GoToBehindLava(GoToLocal):
    """One room and one object, with lava on the straight paths to it.

    One lava cell is on the agent's row, and one on the agent's column, between agent and object.
    With `wide`, their neighbours to both sides of the path are lava too, at most five cells in all.

    Attributes:
        wide: whether to add lava beside the first cells.
    """

    def __init__(self, room_size: int, wide: bool) -> None:
        self.wide = wide
        super().__init__(room_size=room_size, num_dists=1)

    def gen_mission(self) -> None:
        """Places agent and objects, and sets the instruction."""
        super().gen_mission()
        (x, y), (far_x, far_y) = agent_cell(self), target_cell(self)
        lava: list[Cell] = []
        beside: list[Cell] = []
        if abs(far_x - x) >= 2:
            at = int(self._rand_int(min(x, far_x) + 1, max(x, far_x)))
            lava.append((at, y))
            beside += [(at, y - 1), (at, y + 1)]
        if abs(far_y - y) >= 2:
            at = int(self._rand_int(min(y, far_y) + 1, max(y, far_y)))
            lava.append((x, at))
            beside += [(x - 1, at), (x + 1, at)]
        if self.wide:
            lava += [cell for cell in beside if cell not in lava]
        for cell in free_cells(self, list(dict.fromkeys(lava)))[:MOST_LAVA]:
            self.grid.set(*cell, Lava())
        require_a_way(self, target_cell(self))


class GoToAmongLava(GoTo):
    """The paper's maze with lava at random cells of its rooms.

    Attributes:
        cells: number of lava cells.
    """

    def __init__(self, cells: int, **rooms: int) -> None:
        self.cells = cells
        super().__init__(**rooms, doors_open=True)

    def gen_mission(self) -> None:
        """Places agent and objects, and sets the instruction."""
        super().gen_mission()
        for _ in range(self.cells):
            column, row = self._rand_int(0, self.num_cols), self._rand_int(0, self.num_rows)
            room = self.get_room(column, row)
            self.place_obj(Lava(), room.top, room.size, max_tries=1000)
        require_a_way(self, target_cell(self))


class GoToBehindObstacles(RoomGridLevel):
    """One room, a key three columns and three rows away, and obstacles in the square between.

    Attributes:
        obstacles: number of obstacles.
    """

    def __init__(self, room_size: int, obstacles: int) -> None:
        self.obstacles = obstacles
        super().__init__(num_rows=1, num_cols=1, room_size=room_size)

    def gen_mission(self) -> None:
        """Places agent and objects, and sets the instruction."""
        self.place_agent()
        x, y = agent_cell(self)
        far_x, far_y = x + 3 * self._rand_elem([-1, 1]), y + 3 * self._rand_elem([-1, 1])
        inside = range(1, self.room_size - 1)
        if far_x not in inside or far_y not in inside:
            raise RejectSampling("no room for the key")
        key = Key(self._rand_color())
        self.put_obj(key, far_x, far_y)
        between = [
            (a, b)
            for a in range(min(x, far_x), max(x, far_x) + 1)
            for b in range(min(y, far_y), max(y, far_y) + 1)
        ]
        for cell in self._rand_subset(free_cells(self, between), self.obstacles):
            kind = self._rand_elem([Ball, Box])
            self.put_obj(kind(self._rand_color()), *cell)
        self.check_objs_reachable()
        self.instrs = GoToInstr(ObjDesc(key.type, key.color))


class GoToVia(GoToLocal):
    """One room with objects, and a coloured cell that the agent should visit first.

    The instruction does not mention the coloured cell.
    """

    def gen_mission(self) -> None:
        """Places agent and objects, and sets the instruction."""
        super().gen_mission()
        x, y = self.place_obj(Floor("yellow"))
        require_a_way(self, (int(x), int(y)))


class PickUpLocal(GoToLocal):
    """Pick up the only object of a room."""

    def gen_mission(self) -> None:
        """Places agent and objects, and sets the instruction."""
        super().gen_mission()
        self.instrs = PickupInstr(self.instrs.desc)  # type: ignore[assignment]


class PickUp(GoTo):
    """Pick up the only object of a maze."""

    def gen_mission(self) -> None:
        """Places agent and objects, and sets the instruction."""
        super().gen_mission()
        self.instrs = PickupInstr(self.instrs.desc)  # type: ignore[assignment]


def require_a_way(env: RoomGridLevel, to: Cell) -> None:
    """Rejects a level that is being made if lava or objects block every path to a cell.

    Raises:
        RejectSampling: every path is blocked; MiniGrid then makes the level anew.
    """
    if to not in path_lengths(env.grid, agent_cell(env), through_objects=False):
        raise RejectSampling("something is on every way")
