"""Presets of star graphs: a plan is the whole way, the most certain node first."""

from typing import Any

from leapjax.agents.learning import TrainingConfig
from leapjax.configuration import AnyConfig, Config
from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.stars.domain import LARGE, Settings
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

DEMONSTRATIONS = 100  # augmentation makes any graph of any other
EPISODES = 500
TRAINING = {"steps": 4000, "batch": 128, "learning_rate": 1e-3}


def paper(name: str, method: str) -> AnyConfig:
    """The paper's training; its network reads no graphs.

    Raises:
        UserError: an unknown level.
    """
    training = paper_training(method, **TRAINING, **_windows(method))
    return _config(name, method, "paper", paper_model(method), training, Settings())


def leapjax(name: str, method: str) -> AnyConfig:
    """Our network.

    Raises:
        UserError: an unknown level.
    """
    changes, large = dict(TRAINING), {}
    options = Settings()
    if method == "leap" and graphs.find_level(name).nodes > LARGE:
        # It takes long to find out by itself which edge leads where.
        large, options = {"neighbours": True}, Settings(fewer_arms=True)
        changes["batch"] = 64
    training = our_training(method, **changes, **_windows(method))
    return _config(name, method, "leapjax", our_model(method, **large), training, options)


def _windows(method: str) -> dict[str, Any]:
    """LEAP executes the whole plan, so only the beginning of an episode is ever asked for."""
    return {"windows": "start"} if method == "leap" else {}


def _config(
    name: str,
    method: str,
    preset: str,
    model: ModelConfig,
    training: TrainingConfig,
    options: Settings,
) -> AnyConfig:
    star = graphs.find_level(name)
    masking = "each" if preset == "paper" else "random"
    return Config(
        domain="stars",
        level=name,
        method=method,
        preset=preset,
        demos=demonstrations(method, DEMONSTRATIONS),
        episodes=EPISODES,
        model=model,
        training=training,
        planner=search(method, star.length, star.length, fill="confident"),
        method_settings=settings(method, masking=masking),
        domain_settings=options,
    )
