"""Presets of Atari: the paper's (appendix, tables 7 and 9) and ours."""

from typing import Any

from leapjax.agents import cql, dt
from leapjax.configuration import AnyConfig, Config
from leapjax.domains.atari.domain import LONGEST, Settings
from leapjax.domains.atari.encoders import STACK
from leapjax.domains.atari.games import find_game
from leapjax.planners import PlannerConfig
from leapjax.presets import common

TEST_SEED = 20_000_000  # of the first game; games before it helped to choose the data
EPISODES = 20  # games
ALL = 100_000  # demonstrations: more than the data of any game hold
# (T, N, batch size) by game.
PAPER = {
    "Breakout": (5, 10, 64), "Qbert": (5, 10, 64), "Pong": (5, 10, 256), "Seaquest": (10, 30, 128),
}  # fmt: skip
PAPER_TRANSITIONS = 500_000  # 1% of the data of DQN-Replay
EPOCHS = 10
PAST = 25  # number of past states in the paper's contexts
IMITATORS = ("leap", "bc", "dt")  # these draw actions: serving the ball can be improbable


def paper(name: str, method: str) -> AnyConfig:
    """Returns the paper's network, data and training.

    Raises:
        UserError: the game is unknown.
    """
    find_game(name)
    horizon, iterations, batch = PAPER[name]
    training = common.paper_training(
        method, steps=EPOCHS * PAPER_TRANSITIONS // batch, batch=batch, windows="step",
        **({"microbatch": 0} if method == "leap" else {}),
    )  # fmt: skip
    return _configure(
        name,
        method,
        preset="paper",
        context=PAST,
        model=common.paper_model(method, layers=6, heads=8, attention="causal"),
        training=training,
        planner=_search(method, horizon, iterations, 1.0),
        method_settings=_settings(name, method, masking="one"),
        domain_settings=Settings(transitions=PAPER_TRANSITIONS),
    )


def leapjax(name: str, method: str) -> AnyConfig:
    """Returns a small network, which trains in ten minutes on one core, on few transitions.

    Raises:
        UserError: the game is unknown.
    """
    find_game(name)
    # Sprites in Seaquest face the way they move, so imitators need no past there. Imitators that
    # see the past learn to continue as before.
    blind = method in IMITATORS and name == "Seaquest"
    # Encoding the frames costs more than masking a plan in T ways, so T copies share the frames.
    own = _settings(name, method, masking="stratified")
    if method == "cql":
        own = cql.Settings(alpha=1.0)  # with a smaller value it fails to learn in so few steps
    return _configure(
        name,
        method,
        preset="leapjax",
        context=0 if blind else STACK - 1,
        model=common.our_model(method, layers=2, width=64),
        training=common.our_training(method, steps=10_000, windows="step", learning_rate=1e-3),
        planner=_search(method, 5, 5, 0.1),
        method_settings=own,
        domain_settings=Settings(
            transitions=transitions(name), features=16, mirror=True, max_steps=LONGEST
        ),
    )


def transitions(name: str) -> int:
    """Returns how many transitions of a game preset `leapjax` learns from."""
    return 200_000 if name == "Seaquest" else 50_000


def _configure(name: str, method: str, **fields: Any) -> AnyConfig:
    """Makes a configuration from the fields that both presets share and from `fields`."""
    return Config(
        domain="atari",
        level=name,
        method=method,
        demos=common.demonstrations(method, ALL),
        episodes=EPISODES,
        test_seed=TEST_SEED,
        executed=1,
        **fields,
    )


def _search(method: str, horizon: int, iterations: int, temperature: float) -> PlannerConfig:
    """Returns the search of a method; only imitators draw actions at the temperature."""
    return common.search(method, horizon, iterations, temperature if method in IMITATORS else 0.0)


def _settings(name: str, method: str, masking: str) -> Any:
    """Returns settings: LEAP and Decision Transformer get a target return, LEAP no end action."""
    target = find_game(name).target
    if method == "dt":
        return dt.Settings(target)
    return common.settings(method, masking=masking, end=False, returns=True, target_return=target)
