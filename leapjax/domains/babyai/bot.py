"""The demonstrator of BabyAI levels: MiniGrid's bot with the full view of the grid."""

import contextlib
from collections.abc import Iterator
from typing import Any

from minigrid.core.world_object import Door
from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel
from minigrid.envs.babyai.core.verifier import PutNextInstr
from minigrid.utils.baby_ai_bot import BabyAIBot, DropSubgoal, GoNextToSubgoal, OpenSubgoal

FOLLOW, MEASURE, DROP = "follow", "measure", "drop"  # purposes of a path
MOST_LOOKS = 200  # looks at its subgoals after which a bot without an action is stuck


class Undecided(Exception):
    """The bot goes from subgoal to subgoal without an action."""


class LockedOut(Exception):
    """The path to a subgoal leads through a locked door.

    Attributes:
        door: the first locked door on the path.
    """

    def __init__(self, door: Door) -> None:
        super().__init__(door)
        self.door = door


class FullViewBot(BabyAIBot):
    """MiniGrid's bot with the full view of the grid, which is the paper's demonstrator.

    BabyAI's bot explores, because it sees the grid only through its 7x7 view. The paper's
    demonstrations are optimal. Its authors' code lets the bot see the whole grid, and plan through
    doors that are closed but not locked (`full_obs_replan` in their fork). Demonstrations of
    GoToObjMazeS7 then have 19 steps instead of 48, and are a function of the learner's observation.

    Where all paths lead through locked doors, this bot fetches the key of the first, and opens it.
    It also knows what to do with an object that it carries from the start.
    """

    def __init__(self, env: RoomGridLevel) -> None:
        self._opens_locked = False  # whether paths may lead through locked doors
        self._purpose = FOLLOW  # of the paths that it searches for
        super().__init__(env)
        self.vis_mask[:] = True

    def replan(self, action_taken: Any = None) -> Any:
        """Returns the next action, given the last one.

        Raises:
            Undecided: the subgoals lead to no action.
        """
        self._check_erroneous_box_opening(action_taken)
        for subgoal in self.stack:
            subgoal.update_agent_attributes()
        if self.stack:
            self.stack[-1].replan_after_action(action_taken)
        while self.stack and self.stack[-1].is_exploratory():
            self.stack.pop()
        action = self._choose()
        self._remember_current_state()
        return action

    def _choose(self) -> Any:
        """Asks the subgoals until one gives an action."""
        for _ in range(MOST_LOOKS):
            if not self.stack:
                return self.mission.unwrapped.actions.done
            try:
                action = self.stack[-1].replan_before_action()
            except LockedOut as found:
                self.stack.append(OpenSubgoal(self))
                self.stack.append(GoNextToSubgoal(self, found.door, reason="Open"))
                continue
            if action is not None:
                return action
        raise Undecided

    def _process_instr(self, instr: Any) -> None:
        """Plans an instruction; an object to put next to another may be in hand already."""
        held = self.mission.unwrapped.carrying
        if held is not None and isinstance(instr, PutNextInstr) and held in instr.desc_move.obj_set:
            self.stack.append(DropSubgoal(self))
            self.stack.append(GoNextToSubgoal(self, instr.desc_fixed, reason="PutNext"))
        else:
            super()._process_instr(instr)

    def _find_obj_pos(self, obj_desc, adjacent=False):  # noqa: ANN001, ANN202
        """Finds the nearest match of a description, perhaps behind a locked door."""
        with self._search_to(MEASURE):
            return super()._find_obj_pos(obj_desc, adjacent)

    def _find_drop_pos(self, except_pos=None):  # noqa: ANN001, ANN202
        """Finds a place to drop an object, on this side of locked doors."""
        with self._search_to(DROP):
            return super()._find_drop_pos(except_pos)

    @contextlib.contextmanager
    def _search_to(self, purpose: str) -> Iterator[None]:
        """Searches for paths for another purpose than to follow them, for a while."""
        self._purpose = purpose
        try:
            yield
        finally:
            self._purpose = FOLLOW

    def _shortest_path(self, accept_fn, try_with_blockers=False):  # noqa: ANN001, ANN202
        """Finds a path; only if there is none, a path through locked doors.

        Raises:
            LockedOut: the path leads through a locked door, and the bot would follow it.
        """
        found = super()._shortest_path(accept_fn, try_with_blockers)
        if found[0] is not None or self._purpose == DROP:
            return found
        self._opens_locked = True
        try:
            path, finish, with_blockers = super()._shortest_path(accept_fn, try_with_blockers)
        finally:
            self._opens_locked = False
        if path and self._purpose == FOLLOW:
            cells = (self.mission.unwrapped.grid.get(*place) for place in path[:-1])
            locked = (cell for cell in cells if isinstance(cell, Door) and cell.is_locked)
            if (door := next(locked, None)) is not None:
                raise LockedOut(door)
        return path, finish, with_blockers

    def _breadth_first_search(self, initial_states, accept_fn, ignore_blockers):  # noqa: ANN001, ANN202
        """Searches as the bot does, but passes closed doors like open doors."""
        grid = self.mission.unwrapped.grid
        doors = (cell for cell in grid.grid if isinstance(cell, Door) and not cell.is_open)
        closed = [door for door in doors if self._opens_locked or not door.is_locked]
        known = {id(door) for door in closed}

        def accept(position, cell):  # noqa: ANN001, ANN202
            if id(cell) not in known:
                return accept_fn(position, cell)
            with _set_open([cell], False):  # show the door as it is
                return accept_fn(position, cell)

        # The search only asks whether a door is open, so all doors are open while it runs.
        with _set_open(closed, True):
            return super()._breadth_first_search(initial_states, accept, ignore_blockers)


@contextlib.contextmanager
def _set_open(doors: list[Door], is_open: bool) -> Iterator[None]:
    """Opens or closes doors for a while."""
    for door in doors:
        door.is_open = is_open
    try:
        yield
    finally:
        for door in doors:
            door.is_open = not is_open
