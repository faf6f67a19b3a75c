"""Demonstrations of BabyAI levels from MiniGrid's bot."""

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from leapjax.data import seeds
from leapjax.domain import Collection
from leapjax.domains.babyai import vocabulary
from leapjax.domains.babyai.adapter import END, BabyAIAdapter
from leapjax.domains.babyai.bot import FullViewBot
from leapjax.domains.babyai.encoders.cells import OUTSIDE
from leapjax.domains.babyai.levels import Level
from leapjax.domains.babyai.observations import Observation
from leapjax.environments import closing
from leapjax.errors import UserError
from leapjax.types import Demonstration

MISTAKES = 2  # stream of a level seed's random numbers, for mistakes
FAILED = "failed"  # the bot gave up, crashed or ran out of time
SIDES = (8, 11, 13, 16, 22)  # of grids in a batch: a program is compiled for each
OTHER_GOAL = "ended at another match than the nearest"


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
    bot = FullViewBot(adapter.env)
    action, success, terminated, truncated = None, False, False, False
    try:
        while not (terminated or truncated):
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


def split_by_side(demonstrations: Sequence[Demonstration]) -> list[list[Demonstration]]:
    """Splits demonstrations by the side of their grids, and cuts the padding of each part."""
    parts: dict[int, list[Demonstration]] = {}
    for demonstration in demonstrations:
        states = demonstration.observations
        grid = states.grid
        known = (grid[0, ..., 0] != OUTSIDE).nonzero()
        needed = int(max(map(np.max, known))) + 1
        side = min((s for s in SIDES if s >= needed), default=grid.shape[1])
        cut = np.ascontiguousarray(grid[:, :side, :side])
        part = parts.setdefault(cut.shape[1], [])
        part.append(demonstration._replace(observations=states._replace(grid=cut)))
    return [_cut_instructions(parts[side]) for side in sorted(parts)]


def _cut_instructions(demonstrations: Sequence[Demonstration]) -> list[Demonstration]:
    """Cuts padding that no instruction of these demonstrations needs."""
    said = np.stack([each.observations.instruction[0] for each in demonstrations])
    longest = int((said != vocabulary.PAD).sum(axis=1).max())

    def cut(demonstration: Demonstration) -> Demonstration:
        states = demonstration.observations
        words = np.ascontiguousarray(states.instruction[:, :longest])
        return demonstration._replace(observations=states._replace(instruction=words))

    return [cut(each) for each in demonstrations]
