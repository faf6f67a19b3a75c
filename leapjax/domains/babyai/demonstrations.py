"""Demonstrations of BabyAI levels from MiniGrid's bot."""

from collections import Counter
from collections.abc import Callable

import numpy as np
from minigrid.core.world_object import Door
from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel
from minigrid.utils.baby_ai_bot import BabyAIBot

from leapjax.data import seeds
from leapjax.domain import Collection
from leapjax.domains.babyai.adapter import END, BabyAIAdapter
from leapjax.domains.babyai.levels import Level
from leapjax.domains.babyai.observations import Observation
from leapjax.environments import closing
from leapjax.errors import UserError
from leapjax.types import Demonstration

MOST_LOOKS = 200  # at its subgoals, before a bot that has not chosen an action never will
MISTAKES = 2  # which of a level seed's streams of random numbers; the adapter has another
FAILED = "failed"  # the bot gave up, crashed or ran out of time
OTHER_GOAL = "ended at another match than the nearest"


class Undecided(Exception):
    """The bot goes from subgoal to subgoal without an action."""


class _Subgoals(list):
    """A bot's stack of subgoals. MiniGrid's bot looks at its top until one gives an action."""

    looks = 0

    def __getitem__(self, index):  # noqa: ANN001, ANN204
        self.looks += 1
        if self.looks > MOST_LOOKS:
            raise Undecided
        return super().__getitem__(index)


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

    def _process_obs(self) -> None:
        """Adds no view to the explored cells: all are explored."""

    def _breadth_first_search(self, initial_states, accept_fn, ignore_blockers):  # noqa: ANN001, ANN202
        """The bot's search, in which a closed door is on the way like an open one."""
        grid = self.mission.unwrapped.grid
        closed = [cell for cell in grid.grid if isinstance(cell, Door) and not cell.is_open]
        # The search only asks whether a door is open: all are while it runs. `accept` sees the
        # doors as they are.
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
    """Makes the demonstrator of a level that was reset.

    If a door is locked, the bot explores to find its key: it then keeps its own partial view.
    """
    locked = any(isinstance(cell, Door) and cell.is_locked for cell in env.grid.grid)
    return BabyAIBot(env) if locked else FullViewBot(env)


def collect(
    level: Level,
    count: int,
    seed: int,
    progress: Callable[[int], None] = lambda done: None,
) -> Collection:
    """Collects `count` demonstrations of a level, drawn anew for each training seed.

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
    found: list[Demonstration] = []
    dropped = Counter({FAILED: 0, OTHER_GOAL: 0})
    level_seeds = seeds.training_seeds(seed)
    with closing(BabyAIAdapter(level)) as adapter:
        while len(found) < count:
            if dropped.total() > 100 + 10 * len(found):
                raise UserError(
                    f"{dropped.total()} of {dropped.total() + len(found)} demonstrations of "
                    f"{level.name} were dropped: the bot cannot solve this level"
                )
            demonstration = demonstrate(adapter, next(level_seeds), dropped)
            if demonstration is not None:
                found.append(demonstration)
                progress(len(found))
    return Collection(found, dropped)


def demonstrate(adapter: BabyAIAdapter, seed: int, dropped: Counter[str]) -> Demonstration | None:
    """Records an episode of the bot; returns `None` and counts in `dropped` if it fails.

    In levels with mistakes, they are executed, and the bot goes on from there. The recorded
    actions are the executed ones, except in levels that mislabel some.
    """
    level, random = adapter.level, np.random.default_rng([seed, MISTAKES])
    states, actions, rewards = [adapter.reset(seed)], [], []
    bot = make_bot(adapter.env)
    bot.stack = _Subgoals(bot.stack)
    action, success, terminated, truncated = None, False, False, False
    try:
        while not (terminated or truncated):
            bot.stack.looks = 0
            action = int(bot.replan(action))
            if action == END:  # `done`: the bot believes the mission over, and it is not
                break
            if random.random() < level.mistakes:
                action = int(random.integers(END))
            observation, reward, terminated, truncated, success = adapter.step(action)[:5]
            action = adapter.taken
            states.append(observation)
            actions.append(action)
            rewards.append(reward)
    except Exception:  # noqa: BLE001  (the bot asserts, and raises, on levels it cannot solve)
        success = False
    if not success:
        dropped[FAILED] += 1
        return None
    if adapter.misled:
        dropped[OTHER_GOAL] += 1
        return None
    wrong = random.random(len(actions)) < level.mislabelled
    labels = np.where(wrong, random.integers(END, size=len(actions)), actions)
    return Demonstration(
        Observation(*(np.stack(parts) for parts in zip(*states, strict=True))),
        labels.astype(np.int32),
        np.array(rewards, np.float32),
        terminated,
        truncated,
        seed,
    )
