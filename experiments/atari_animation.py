"""An animated GIF of a planner's game, with the planned actions beside it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from experiments.common.episodes import watch_episode
from experiments.common.pictures import Frame, save_animation
from leapjax.environments import closing
from leapjax.pretrained import Pretrained
from leapjax.running.run import Run
from leapjax.types import Plan

SIDE, MARGIN, LINE = 252, 150, 18  # pixels: the game, the plan beside it, a line of the plan
MOST_DECISIONS = 300  # plans of the game, at most
SHOWN, STEP_MS = 2, 60  # draws every second decision, each for so many milliseconds
WHITE, BLACK, GREY, BLUE = (255, 255, 255), (0, 0, 0), (150, 150, 150), (40, 110, 220)


def animate(planner: Pretrained, run: Run, seeds: Sequence[int], path: Path) -> None:
    """Draws every second decision at the beginning of one game."""
    from leapjax.domains.atari.adapter import AtariAdapter  # noqa: PLC0415  (ale-py is optional)

    actions, title = run.domain.actions, run.domain.level
    frames: list[Frame] = []
    step = 0
    with closing(run.domain.make_adapter()) as adapter:
        assert isinstance(adapter, AtariAdapter)
        context, executed = planner.specification.context, run.config.executed
        for event in watch_episode(
            adapter, planner, context, seeds[0], run.seed, executed, MOST_DECISIONS
        ):
            if not isinstance(event, Plan):
                step += 1
            elif step % SHOWN == 0:
                plan = np.asarray(event.actions[0])
                drawn = draw_picture(adapter.frame, plan, actions, adapter.score, title)
                frames.append((drawn, STEP_MS))
    save_animation(frames, path)


def draw_picture(
    frame: np.ndarray, plan: np.ndarray, actions: Sequence[str], score: float, title: str
) -> Image.Image:
    """Draws a frame `[84, 84]` and a plan `[T]` beside it, with the first action in blue."""
    image = Image.new("RGB", (SIDE + MARGIN, SIDE), WHITE)
    image.paste(Image.fromarray(frame).resize((SIDE, SIDE), Image.Resampling.NEAREST))
    pen = ImageDraw.Draw(image)
    left = SIDE + 10
    pen.text((left, 8), f"{title}: {score:g}", fill=BLACK)
    pen.text((left, 8 + 2 * LINE), "plan", fill=GREY)
    for place, action in enumerate(plan.tolist()):
        said = f"{place + 1}. {actions[action]}"
        pen.text((left, 8 + (3 + place) * LINE), said, fill=BLUE if place == 0 else GREY)
    return image
