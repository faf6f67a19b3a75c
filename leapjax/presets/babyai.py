"""Presets of BabyAI: the paper's (appendix, tables 5, 6 and 8) and ours."""

from typing import Any

from leapjax.configuration import AnyConfig, Config
from leapjax.domains.babyai.levels import Level, find_level
from leapjax.domains.babyai.settings import Settings
from leapjax.planners import BeamConfig, PlannerConfig
from leapjax.presets import common

DEMONSTRATIONS = 500  # per level: section 5
_EASY = ("GoToLocal", "GoToBehindObstacles", "PickUpLocal")  # one room, no words for places


def paper(name: str, method: str) -> AnyConfig:
    """Returns the paper's network and training; follows the authors' code where they differ.

    Raises:
        UserError: the level is unknown.
    """
    level = find_level(name)
    horizon, iterations = level.horizon, level.iterations
    if method == "leap" and level.name.startswith("GoToObjMazeS7"):
        horizon, iterations = 10, 30  # the network learns less with the appendix's 15 and 50
    return Config(
        domain="babyai",
        level=name,
        method=method,
        preset="paper",
        demos=common.demonstrations(method, DEMONSTRATIONS),
        context=_paper_context(level, method),
        model=common.paper_model(method),
        training=common.paper_training(method, **_paper_changes(level, method)),
        planner=common.search(method, horizon, iterations),
        method_settings=_paper_settings(level, method),
        domain_settings=Settings(),
    )


def leapjax(name: str, method: str) -> AnyConfig:
    """Returns our encoder, augmentation and training, all chosen on validation levels.

    Raises:
        UserError: the level is unknown.
    """
    level = find_level(name)
    if level.members:
        return _together(level, method)
    # The usual 3e-3 is too high for LEAP in large levels.
    rate = {"learning_rate": 1.5e-3} if _is_large(level) and method == "leap" else {}
    return Config(
        domain="babyai",
        level=name,
        method=method,
        preset="leapjax",
        demos=common.demonstrations(method, DEMONSTRATIONS),
        episodes=500,  # a success rate near 100% needs more than the paper's 200
        context=level.context,
        model=common.our_model(method),
        training=common.our_training(method, steps=_steps(level), **rate),
        planner=_our_search(level, method),
        method_settings=common.settings(method, masking="random"),
        domain_settings=_augmented(level),
    )


def _together(level: Level, method: str) -> AnyConfig:
    """Returns a configuration for one planner of many levels."""
    return Config(
        domain="babyai",
        level=level.name,
        method=method,
        preset="leapjax",
        demos=common.demonstrations(method, 300 * len(level.members)),
        episodes=200,  # of each level, too
        context=64,  # past steps, which show the tasks that are done
        model=common.our_model(method),
        training=common.our_training(method, steps=_steps(level), learning_rate=1.5e-3),
        planner=_our_search(level, method),
        method_settings=common.settings(method, masking="random"),
        domain_settings=Settings(
            augment=True, hidden_goals=0.5, fields=12, sweeps=48, word_heads=4, memory=True
        ),
    )


def _paper_context(level: Level, method: str) -> int:
    """Returns K; methods of single actions see as many states as the appendix has, with today's."""
    return level.context if method in (*common.SEQUENCE, "random") else level.states - 1


def _paper_changes(level: Level, method: str) -> dict[str, Any]:
    """Returns the microbatch of LEAP: longer plans put more copies of each window in the cache."""
    if method != "leap":
        return {}
    if level.horizon > 5:
        return {"microbatch": 2}
    return {"microbatch": 0} if level.name == "PickUpLoc" else {}


def _paper_settings(level: Level, method: str) -> Any:
    """Returns settings: LEAP masks every action of a window in turn, as the authors' code does.

    In PickUpLoc it learns from the state alone: it masks all actions, in one copy of each window.
    """
    masking = "all" if level.name == "PickUpLoc" else "each"
    return common.settings(method, masking=masking, end=False, repeat_state=False)


def _our_search(level: Level, method: str) -> PlannerConfig:
    """Returns a search with N = T: more passes than positions bring no gain.

    Noise leads out of dead ends. Temperatures are in the units of a method's energies: nats, or
    Q-values.
    """
    temperature = 0.5 if method == "leap" else 0.0
    # Tasks of sequences are long, so dead ends are frequent. One planner of many levels does better
    # on validation levels with less noise.
    if level.sequence and not level.members:
        noise = {"leap": 1.0, "bc": 1.0, "dt": 1.0, "iql": 1.0, "mopo": 1.0, "bcq": 0.1}
        temperature = {**noise, "plate": 2.0}.get(method, temperature)
    beams = 1 if level.sequence else BeamConfig.beams
    return common.search(method, level.horizon, level.horizon, temperature, beams=beams)


def _augmented(level: Level) -> Settings:
    """Returns the options of encoder and augmentation for a level.

    In the paper's levels keys open no doors, so objects can be exchanged. Their instructions name
    kind and colour, so they cannot mean clutter. Other levels may break both rules.
    """
    familiar = bool(level.task)
    return Settings(
        augment=True,
        exchange_objects=familiar,
        clutter=0.4 if familiar else 0.0,
        sweeps=_sweeps(level),
        word_heads=4 if level.sequence else 0,
    )


def _steps(level: Level) -> int:
    """Returns the training steps after which success on validation levels stops rising.

    The planner of all levels has as many as two cores make in little more than an hour.
    """
    if level.members:
        return min(1200 * len(level.members), 30_000)
    if _is_large(level):
        return 4000
    return 1000 if level.task in _EASY else 2000


def _side(level: Level) -> int:
    """Returns the side of a paper's level, in cells."""
    return max(level.rows, level.columns) * (level.room_size - 1) + 1


def _is_large(level: Level) -> bool:
    """Returns whether paths through a level are so long that they are hard to learn."""
    return bool(level.task) and _side(level) > 15


def _sweeps(level: Level) -> int:
    """Returns the rounds of value iteration: the number of cells on a long path in the level."""
    if not level.task:
        return 48
    alone = level.rows * level.columns == 1
    return (2 if alone else 4) * _side(level)  # paths wind from room to room
