"""Demonstrations of BabyAI levels from MiniGrid's bot."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from minigrid.core.world_object import Door
from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel
from minigrid.utils.baby_ai_bot import BabyAIBot

from leapjax.data import seeds
from leapjax.envs import levels, observations, vocabulary
from leapjax.envs.adapter import END
from leapjax.envs.levels import Level
from leapjax.errors import UserError
from leapjax.types import Observation


class Demonstration(NamedTuple):
    """One successful episode of `n` steps."""

    observations: Observation  # [n + 1, ...] the state before each action, and the last
    actions: np.ndarray  # [n] int32
    seed: int  # of the level


@dataclasses.dataclass
class Collection:
    """Demonstrations, and what was dropped on the way to them."""

    demonstrations: list[Demonstration]
    failed: int = 0  # the bot gave up, crashed or ran out of time
    other_goal: int = 0  # it ended at another match than the nearest


class FullViewBot(BabyAIBot):
    """MiniGrid's bot with the full view of the grid, which is the paper's demonstrator.

    The bot of BabyAI explores: it knows only what its 7x7 view has shown it. The paper's
    demonstrations are optimal, and its authors' code lets the bot see the whole grid and
    plan through doors that are closed but not locked (`full_obs_replan` in their fork).
    Demonstrations of GoToObjMazeS7 are then 19 steps long, not 48, and a function of what
    the learner observes.
    """

    def __init__(self, env: RoomGridLevel) -> None:
        super().__init__(env)
        self.vis_mask[:] = True

    def _breadth_first_search(self, initial_states, accept_fn, ignore_blockers):  # noqa: ANN001, ANN202
        """The bot's search, in which a closed door is on the way like an open one."""
        grid = self.mission.unwrapped.grid
        closed = [cell for cell in grid.grid if isinstance(cell, Door) and not cell.is_open]
        # The search asks a door only whether it is open: answer yes while it runs. What is
        # accepted is asked of the doors as they are.
        states = {id(door): False for door in closed}

        def accept(position, cell):  # noqa: ANN001, ANN202
            if id(cell) not in states:
                return accept_fn(position, cell)
            cell.is_open = False
            try:
                return accept_fn(position, cell)
            finally:
                cell.is_open = True

        for door in closed:
            door.is_open = True
        try:
            return super()._breadth_first_search(initial_states, accept, ignore_blockers)
        finally:
            for door in closed:
                door.is_open = False


def make_bot(env: RoomGridLevel) -> BabyAIBot:
    """The demonstrator of a level that was reset.

    Where a door is locked the bot must look for its key, which it does by exploring: there
    it keeps its own partial view.
    """
    locked = any(isinstance(cell, Door) and cell.is_locked for cell in env.grid.grid)
    return BabyAIBot(env) if locked else FullViewBot(env)


def collect(
    level: Level,
    count: int,
    seed: int,
    progress: Callable[[int], None] = lambda done: None,
) -> Collection:
    """`count` demonstrations of a level, drawn anew for each training seed.

    Args:
        level: what to demonstrate.
        count: how many demonstrations to return, at least 1.
        seed: of the training run; see `leapjax.data.seeds`.
        progress: called with the number of demonstrations so far.

    Raises:
        UserError: no demonstration asked for, or the bot fails nearly always.
    """
    if count < 1:
        raise UserError(f"at least one demonstration is needed, got {count}")
    env = levels.make_environment(level)
    side = max(env.width, env.height)
    result = Collection([])
    level_seeds = seeds.training_seeds(seed)
    while len(result.demonstrations) < count:
        dropped = result.failed + result.other_goal
        if dropped > 100 + 10 * count:
            raise UserError(
                f"{dropped} of {dropped + len(result.demonstrations)} demonstrations of "
                f"{level.name} were dropped: the bot cannot solve this level"
            )
        demonstration = demonstrate(env, level, side, next(level_seeds), result)
        if demonstration is not None:
            result.demonstrations.append(demonstration)
            progress(len(result.demonstrations))
    return result


def demonstrate(
    env: RoomGridLevel, level: Level, side: int, seed: int, tally: Collection
) -> Demonstration | None:
    """One episode of the bot; None, counted in `tally`, where it has to be dropped."""
    with levels.silenced():
        env.reset(seed=seed)
    goal = observations.nearest_goal(env)
    instruction = vocabulary.encode(env.mission, level.words)
    states = [observations.observe(env, side, goal, instruction)]
    actions: list[int] = []
    bot = make_bot(env)
    action, reward, over = None, 0.0, False
    try:
        while not over:
            action = int(bot.replan(action))
            if action == END:  # `done`: the bot believes the mission over, and it is not
                break
            _, reward, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            actions.append(action)
            states.append(observations.observe(env, side, goal, instruction))
    except Exception:  # noqa: BLE001  (the bot asserts, and raises, on levels it cannot solve)
        reward = 0.0
    if float(reward) <= 0:
        tally.failed += 1
        return None
    if goal != observations.NO_GOAL and observations.front_cell(env) != goal:
        tally.other_goal += 1
        return None
    stacked = Observation(*(np.stack(parts) for parts in zip(*states, strict=True)))
    return Demonstration(stacked, np.array(actions, np.int32), seed)
