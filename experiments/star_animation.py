"""An animated GIF of planners that search for the path through a star graph, side by side."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw

from experiments.common.pictures import Frame, save_animation
from experiments.common.searches import SEARCHES, list_searches
from leapjax import rollouts
from leapjax.batching import compile_planner, plan_keys
from leapjax.domains.puzzles.stars.graphs import Graph, Star, StarAdapter, find_level
from leapjax.pretrained import Pretrained
from leapjax.running.run import Run

SIDE, CAPTION, RADIUS = 330, 44, 11  # pixels, as are the next two
SPACING, MOST = 28, 1000  # between two nodes; of a side, at most
PASS_MS, LAST_MS = 700, 2200
SHOWN = ("Gibbs sampling, random order", "most certain first")
WHITE, GREY, BLACK = (255, 255, 255), (170, 170, 170), (0, 0, 0)
BLUE, LIGHT, GREEN, RED = (80, 160, 255), (205, 228, 255), (60, 170, 80), (215, 70, 60)


def animate(planner: Pretrained, run: Run, seeds: Sequence[int], path: Path) -> None:
    """Draws the passes over one graph per level seed; skips methods that plan one action."""
    if not list_searches(run.config):
        return
    horizon, fills = run.config.planner.horizon, planner.energy.accepts_mask
    shown = [s for s in SEARCHES if s.name in SHOWN and s.passes == 1]
    chosen = {s.name: s.of(horizon) for s in shown if fills or "fill" not in s.options}
    star = find_level(run.domain.level)
    plans = {
        name: compile_planner(
            planner.energy, dataclasses.replace(run.config.planner, **options),
            (1,), jax.devices()[:1],
        )
        for name, options in chosen.items()
    }  # fmt: skip
    frames: list[Frame] = []
    for seed in seeds:
        adapter = StarAdapter(star)
        graph = adapter.reset(seed)
        history = rollouts.History(graph, planner.specification.context, adapter.num_actions)
        contexts = rollouts.stack_contexts([history])
        keys = plan_keys(run.seed, np.array([seed]), np.array([0]))
        traces = {
            name: np.asarray(plan(planner.params, keys, contexts).trace[0])[:, : star.length]
            for name, plan in plans.items()
        }
        frames += _draw_frames(star, graph, adapter.solution, traces)
    save_animation(frames, path)


def _draw_frames(
    star: Star, graph: Graph, path: np.ndarray, traces: dict[str, np.ndarray]
) -> list[Frame]:
    """Draws one frame for each pass, with the planners side by side."""
    places, side = place_nodes(star, graph), choose_side(star)
    passes = len(next(iter(traces.values())))
    found = []
    for index in range(passes):
        image = Image.new("RGB", (side * len(traces), side + CAPTION), WHITE)
        for column, (name, trace) in enumerate(traces.items()):
            last = index == passes - 1
            panel = draw_picture(graph, places, side, path, trace[: index + 1], name, last)
            image.paste(panel, (side * column, 0))
        found.append((image, LAST_MS if index == passes - 1 else PASS_MS))
    return found


def choose_side(star: Star) -> int:
    """Returns a picture's side in pixels: its nodes do not overlap, unless it gets too large."""
    return min(max(SIDE, 2 * (SPACING * star.length + 2 * RADIUS)), MOST)


def place_nodes(star: Star, graph: Graph) -> dict[int, tuple[float, float]]:
    """Returns the position of each node: the centre in the middle, arms as rays."""
    after: dict[int, list[int]] = {}
    for parent, child in graph.edges.tolist():
        after.setdefault(parent, []).append(child)
    middle = choose_side(star) / 2
    step = (middle - 2 * RADIUS) / star.length
    places = {int(graph.node): (middle, middle)}
    for arm, first in enumerate(sorted(after[int(graph.node)])):
        angle = 2 * math.pi * arm / star.arms - math.pi / 2
        node, distance = first, step
        while True:
            places[node] = middle + distance * math.cos(angle), middle + distance * math.sin(angle)
            if node not in after:
                break
            (node,) = after[node]
            distance += step
    return places


def draw_picture(
    graph: Graph,
    places: dict[int, tuple[float, float]],
    side: int,
    path: np.ndarray,
    trace: np.ndarray,
    name: str,
    last: bool,
) -> Image.Image:
    """Draws the graph and the plan after the last pass of `trace [n, T]`, with a caption.

    Nodes of the plan are light blue, and dark blue if this pass changed them. After the last pass
    right nodes are green, and wrong nodes red.
    """
    image = Image.new("RGB", (side, side + CAPTION), WHITE)
    pen = ImageDraw.Draw(image)
    plan = trace[-1]
    new = plan != (trace[-2] if len(trace) > 1 else np.full_like(plan, -1))
    for parent, child in graph.edges.tolist():
        pen.line([places[parent], places[child]], fill=GREY, width=2)
    colours = {}
    for position, node in enumerate(plan.tolist()):
        done = GREEN if node == path[position] else RED
        colours[node] = done if last else BLUE if new[position] else LIGHT
    for node, (x, y) in places.items():
        box = (x - RADIUS, y - RADIUS, x + RADIUS, y + RADIUS)
        goal = node == int(graph.goal)
        pen.ellipse(box, fill=colours.get(node, WHITE), outline=BLACK, width=3 if goal else 1)
        pen.text((x, y), str(node), fill=BLACK, anchor="mm")
    known = [str(node) if node in places else "?" for node in plan.tolist()]
    pen.text((6, side + 4), f"{name}: pass {len(trace)}", fill=BLACK)
    way = f"from {int(graph.node)} to {int(graph.goal)}: {' '.join(known)}"
    right = np.array_equal(plan, path[: len(plan)])
    pen.text(
        (6, side + 22), f"{way}   {'found' if right else 'wrong'}" if last else way, fill=BLACK
    )
    return image
