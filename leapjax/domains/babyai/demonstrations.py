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

MOST_LOOKS = 200  # looks at its subgoals after which a bot without an action is stuck
MISTAKES = 2  # stream of a level seed's random numbers, for mistakes
FAILED = "failed"  # the bot gave up, crashed or ran out of time
OTHER_GOAL = "ended at another match than the nearest"


class Undecided(Exception):
    """The bot goes from subgoal to subgoal without an action."""


class _Subgoals(list):
    """A bot's stack of subgoals, which raises `Undecided` after too many looks.

    MiniGrid's bot looks at the top of the stack until a subgoal gives an action.
    """

    looks = 0

    def __getitem__(self, index):  # noqa: ANN001, ANN204
        self.looks += 1
        if self.looks > MOST_LOOKS:
            raise Undecided
        return super().__getitem__(index)


class FullViewBot(BabyAIBot):
    """MiniGrid's bot with the full view of the grid, which is the paper's demonstrator.

    BabyAI's bot explores, because it sees the grid only through its 7x7 view. The paper's
    demonstrations are optimal. Its authors' code lets the bot see the whole grid, and plan through
    doors that are closed but not locked (`full_obs_replan` in their fork). Demonstrations of
    GoToObjMazeS7 then have 19 steps instead of 48, and are a function of the learner's observation.
    """

    def __init__(self, env: RoomGridLevel) -> None:
        super().__init__(env)
        self.vis_mask[:] = True

    def _process_obs(self) -> None:
        """Leaves the explored cells unchanged, because all cells are explored."""

    def _breadth_first_search(self, initial_states, accept_fn, ignore_blockers):  # noqa: ANN001, ANN202
        """Searches as the bot does, but passes closed doors like open doors."""
        grid = self.mission.unwrapped.grid
        closed = [cell for cell in grid.grid if isinstance(cell, Door) and not cell.is_open]
        # The search only asks whether a door is open, so all doors are open while it runs. `accept`
        # shows a door as it is.
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

    If a door is locked, the bot must explore to find the key, so it keeps its partial view.
    """
    locked = any(isinstance(cell, Door) and cell.is_locked for cell in env.grid.grid)
    return BabyAIBot(env) if locked else FullViewBot(env)


def collect(
    level: Level,
    count: int,
    seed: int,
    progress: Callable[[int], None] = lambda done: None,
) -> Collection:
    """Collects `count` demonstrations of a level; each training seed has its own.

    Args:
        level: level to demonstrate.
        count: number of demonstrations to return, at least 1.
        seed: seed of the training run; see `leapjax.data.seeds`.
        progress: function to call with the number of demonstrations so far.

    Raises:
        UserError: `count` is less than 1, or the bot nearly always fails.
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

    In levels with mistakes, random actions replace some of the bot's actions, and the bot goes on
    from there. The recorded actions are the executed actions, except in levels with wrong labels.
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
            if action == END:  # `done`: the bot wrongly believes that the mission is over
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
