"""Presets of Sudoku: a plan is the whole board, the most certain cell first."""

from typing import Any

from leapjax.agents.learning import TrainingConfig
from leapjax.configuration import AnyConfig, Config
from leapjax.domains.puzzles.sudoku import boards
from leapjax.domains.puzzles.sudoku.domain import Settings
from leapjax.models.trajectory import ModelConfig
from leapjax.presets.common import (
    demonstrations,
    our_model,
    our_training,
    paper_model,
    paper_training,
    search,
    settings,
)

EPISODES = 500


def paper(name: str, method: str) -> AnyConfig:
    """The paper's training; its network reads no boards.

    Raises:
        UserError: an unknown level.
    """
    training = paper_training(method, **_training(name, method))
    return _config(name, method, "paper", paper_model(method), training)


def leapjax(name: str, method: str) -> AnyConfig:
    """Our network.

    Raises:
        UserError: an unknown level.
    """
    training = our_training(method, **_training(name, method))
    return _config(name, method, "leapjax", our_model(method), training)


def _training(name: str, method: str) -> dict[str, Any]:
    """Twelve minutes on one core for boards of 9x9.

    LEAP executes the whole plan, so only the beginning of an episode is ever asked for.
    """
    small = boards.find_level(name).side == 4
    return {
        "steps": 2000 if small else 1500, "batch": 64 if small else 32, "learning_rate": 1e-3,
        **({"windows": "start"} if method == "leap" else {}),
    }  # fmt: skip


def _config(
    name: str, method: str, preset: str, model: ModelConfig, training: TrainingConfig
) -> AnyConfig:
    size = boards.find_level(name)
    masking = "each" if preset == "paper" else "random"
    return Config(
        domain="sudoku",
        level=name,
        method=method,
        preset=preset,
        demos=demonstrations(method, 500 if size.side == 4 else 2000),
        episodes=EPISODES,
        model=model,
        training=training,
        planner=search(method, size.cells, size.cells, fill="confident"),
        method_settings=settings(method, masking=masking),
        domain_settings=Settings(),
    )
