"""An animated GIF of plans: first refined, then executed on the level."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.babyai_drawing import draw_picture, find_way, spell_actions
from experiments.common.episodes import watch_episode
from experiments.common.pictures import Frame, save_animation
from leapjax.domains.babyai import levels
from leapjax.domains.babyai.adapter import ACTIONS, BabyAIAdapter
from leapjax.domains.babyai.levels import Level
from leapjax.environments import closing
from leapjax.pretrained import Pretrained
from leapjax.running.run import Run
from leapjax.types import Plan

REFINE_MS, STEP_MS, PAUSE_MS = 250, 220, 900
MAX_PLANS = 8  # of an episode, if each plan is executed whole; then it is cut off


def animate(planner: Pretrained, run: Run, seeds: Sequence[int], path: Path) -> None:
    """Draws one episode per level seed, one after the other, with MiniGrid's renderer."""
    level = levels.find_level(run.domain.level)
    frames: list[Frame] = []
    for level_seed in seeds:
        frames += draw_episode(planner, level, level_seed, run.seed, run.config.executed)
    save_animation(frames, path)


def draw_episode(
    planner: Pretrained, level: Level, level_seed: int, seed: int, executed: int | None = None
) -> list[Frame]:
    """Returns the frames of one episode, each with its duration in milliseconds."""
    with closing(BabyAIAdapter(level)) as adapter:
        return _draw_frames(adapter, planner, level_seed, seed, executed)


def _draw_frames(
    adapter: BabyAIAdapter, planner: Pretrained, level_seed: int, seed: int, executed: int | None
) -> list[Frame]:
    frames: list[Frame] = []
    replan = step = 0
    context = planner.specification.context
    horizon = planner.specification.planner.horizon
    # Allows up to three times as many plans if only a part of each is executed.
    most = MAX_PLANS * min(3, -(-horizon // (executed or horizon)))
    for event in watch_episode(adapter, planner, context, level_seed, seed, executed, most):
        if isinstance(event, Plan):
            replan += 1
            trace = np.asarray(event.trace[0])
            for iteration in _distinct(trace):
                which = f"plan {replan}, iteration {iteration + 1} of {len(trace)}"
                text = f"{which}: {spell_actions(trace[iteration])}"
                ways = [find_way(adapter, trace[iteration])]
                frames.append((draw_picture(adapter, text, ways), REFINE_MS))
            frames[-1] = (frames[-1][0], PAUSE_MS)
            continue
        action, transition = event
        step += 1
        over = transition.terminated or transition.truncated
        outcome = ("success" if transition.success else "failed") if over else "executing"
        text = f"step {step}: {ACTIONS[action]}; {outcome}"
        frames.append((draw_picture(adapter, text), PAUSE_MS if over else STEP_MS))
    return frames


def _distinct(trace: np.ndarray) -> list[int]:
    """Returns the iterations that changed the plan, and the last iteration."""
    changed = [0] + [i for i in range(1, len(trace)) if (trace[i] != trace[i - 1]).any()]
    return changed if changed[-1] == len(trace) - 1 else [*changed, len(trace) - 1]
