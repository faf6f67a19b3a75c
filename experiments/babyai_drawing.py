"""Draws BabyAI levels with MiniGrid's renderer, and the paths of plans in them."""

import copy
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from leapjax.domains.babyai.adapter import END, BabyAIAdapter
from leapjax.domains.babyai.observations import Cell, agent_cell

SIDE = 336  # pixels of a level, approximately
CAPTION = 34  # pixels of text below the level
WHITE = (255, 255, 255)
# Colours of the paths in order: blue, orange, green, pink, yellow.
COLOURS = ((80, 160, 255), (255, 150, 50), (90, 220, 120), (255, 110, 200), (240, 230, 80))
GLYPHS = ("L", "R", "F", "pick", "drop", "open", "end", "?")  # the last stands for MASK
Colour = tuple[int, int, int]


def draw_picture(
    adapter: BabyAIAdapter,
    text: str,
    ways: Sequence[Sequence[Cell]] = (),
    marked: Sequence[tuple[Sequence[Cell], Colour]] = (),
) -> Image.Image:
    """Draws the current level, a white frame around its goal, its mission and a caption.

    Args:
        adapter: adapter of the level.
        text: caption.
        ways: paths of cells, each drawn in another colour.
        marked: groups of cells to frame, each with the colour of its frames.
    """
    env, tile = adapter.env, SIDE // adapter.side
    level = Image.fromarray(env.grid.render(tile, tuple(env.agent_pos), env.agent_dir))
    image = Image.new("RGB", (SIDE, SIDE + CAPTION), "white")
    image.paste(level, (0, 0))
    pen = ImageDraw.Draw(image)
    goal = [(int(adapter.goal[0]), int(adapter.goal[1]))] if adapter.goal[0] >= 0 else []
    for cells, colour in ((goal, WHITE), *marked):
        for x, y in cells:
            box = [x * tile, y * tile, (x + 1) * tile - 1, (y + 1) * tile - 1]
            pen.rectangle(box, outline=colour, width=2)
    for index, way in enumerate(ways):
        colour = COLOURS[index % len(COLOURS)]
        points = [((x + 0.5) * tile, (y + 0.5) * tile) for x, y in way]
        if len(points) > 1:
            pen.line(points, fill=colour, width=4, joint="curve")
        last_x, last_y = points[-1]
        pen.ellipse([last_x - 5, last_y - 5, last_x + 5, last_y + 5], fill=colour)
    pen.text((4, SIDE + 2), env.mission[:60], fill="black")
    pen.text((4, SIDE + 18), text, fill="black")
    return image


def spell_actions(actions: np.ndarray) -> str:
    """Abbreviates a plan `[T]`."""
    return " ".join(GLYPHS[int(action)] for action in actions)


def find_way(adapter: BabyAIAdapter, actions: np.ndarray) -> list[Cell]:
    """Plays a plan on a copy of the level; returns the cells that it leads through."""
    copied = copy.deepcopy(adapter.env)
    cells = [agent_cell(copied)]
    for action in actions:
        if action >= END:  # end, or MASK in an incomplete plan
            break
        _, _, terminated, truncated, _ = copied.step(int(action))
        cells.append(agent_cell(copied))
        if terminated or truncated:
            break
    return cells
