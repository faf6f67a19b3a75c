"""Plans being refined, then executed on the real level, as an animated GIF."""

import copy
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel
from PIL import Image, ImageDraw

from experiments.common.pictures import Frame, save_animation
from experiments.common.run import Run
from leapjax import rollouts
from leapjax.babyai import levels
from leapjax.babyai.adapter import ACTIONS, END, BabyAIAdapter
from leapjax.babyai.levels import Level
from leapjax.babyai.observations import Cell, agent_cell
from leapjax.batching import plan_keys
from leapjax.pretrained import Pretrained

SIDE = 336  # pixels of a level, about
CAPTION = 34  # pixels of text below the level
REFINE_MS, STEP_MS, PAUSE_MS = 250, 220, 900
MAX_PLANS = 8  # an episode that needs more is cut off
GLYPHS = dict(zip(range(len(ACTIONS)), ["L", "R", "F", "pick", "drop", "open", "end"], strict=True))


def animate(planner: Pretrained, run: Run, seeds: Sequence[int], path: Path) -> None:
    """Draws one episode per level seed, one after the other, with MiniGrid's renderer."""
    level = levels.find_level(run.domain.level)
    frames: list[Frame] = []
    for level_seed in seeds:
        frames += episode_frames(planner, level, level_seed, run.seed)
    save_animation(frames, path)


def episode_frames(planner: Pretrained, level: Level, level_seed: int, seed: int) -> list[Frame]:
    """The frames of one episode with their durations in milliseconds."""
    adapter = BabyAIAdapter(level)
    context = planner.specification.context
    history = rollouts.History(adapter.reset(level_seed), context, adapter.num_actions)
    mission = adapter.env.mission
    frames = []
    for replan in range(MAX_PLANS):
        keys = plan_keys(seed, np.array([level_seed]), np.array([replan]))
        plan = planner(keys, rollouts.stack_contexts([history]))
        trace = np.asarray(plan.trace[0])
        for iteration in _distinct(trace):
            actions = " ".join(GLYPHS[int(action)] for action in trace[iteration])
            text = f"plan {replan + 1}, iteration {iteration + 1} of {len(trace)}: {actions}"
            image = picture(adapter, mission, text, way(adapter.env, trace[iteration]))
            frames.append((image, REFINE_MS))
        frames[-1] = (frames[-1][0], PAUSE_MS)
        for action in np.asarray(plan.actions[0]):
            if action == END:
                break
            transition = adapter.step(int(action))
            history.advance(int(action), transition.observation, transition.reward)
            over = transition.terminated or transition.truncated
            outcome = ("success" if transition.success else "failed") if over else "executing"
            text = f"step {history.step}: {ACTIONS[action]}; {outcome}"
            frames.append((picture(adapter, mission, text), STEP_MS))
            if over:
                frames[-1] = (frames[-1][0], PAUSE_MS)
                return frames
    return frames


def _distinct(trace: np.ndarray) -> list[int]:
    """The iterations that changed the plan, and the last."""
    changed = [0] + [i for i in range(1, len(trace)) if (trace[i] != trace[i - 1]).any()]
    return changed if changed[-1] == len(trace) - 1 else [*changed, len(trace) - 1]


def picture(
    adapter: BabyAIAdapter, mission: str, text: str, cells: Sequence[Cell] = ()
) -> Image.Image:
    """The level, the goal, a way through some cells if given, and a caption."""
    env = adapter.env
    tile = SIDE // adapter.side
    level_image = Image.fromarray(env.grid.render(tile, tuple(env.agent_pos), env.agent_dir))
    image = Image.new("RGB", (SIDE, SIDE + CAPTION), "white")
    image.paste(level_image, (0, 0))
    pen = ImageDraw.Draw(image)
    if adapter.goal[0] >= 0:
        x, y = adapter.goal
        box = [x * tile, y * tile, (x + 1) * tile - 1, (y + 1) * tile - 1]
        pen.rectangle(box, outline="white", width=2)
    pen.text((4, SIDE + 2), mission[:60], fill="black")
    if cells:
        points = [((x + 0.5) * tile, (y + 0.5) * tile) for x, y in cells]
        if len(points) > 1:
            pen.line(points, fill=(80, 160, 255), width=4, joint="curve")
        last_x, last_y = points[-1]
        pen.ellipse([last_x - 5, last_y - 5, last_x + 5, last_y + 5], fill=(80, 160, 255))
    pen.text((4, SIDE + 18), text, fill="black")
    return image


def way(env: RoomGridLevel, actions: np.ndarray) -> list[Cell]:
    """The cells that a plan leads through, found by playing it on a copy of the level."""
    copied = copy.deepcopy(env)
    cells = [agent_cell(copied)]
    for action in actions:
        if action == END:
            break
        _, _, terminated, truncated, _ = copied.step(int(action))
        cells.append(agent_cell(copied))
        if terminated or truncated:
            break
    return cells
