"""Names of options on the command lines of some domains."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated

import tyro

from leapjax.configuration import AnyConfig, Config, D, M, P


@dataclasses.dataclass(frozen=True)
class GymnasiumConfig(Config[M, D, P]):
    """Train a method on a Minari data set of an environment, then measure its success.

    Attributes:
        level: Id of a Gymnasium environment with discrete actions, or module:id to import the
            module first. Without it, the environment that the data set names.
        demonstrations: Id of a Minari data set of the environment to train on.
        play: Environment to play instead of the environment that the checkpoint's planner was
            trained on.
    """

    level: Annotated[str, tyro.conf.arg(name="env")]
    demonstrations: Annotated[str | None, tyro.conf.arg(name="dataset")] = None


@dataclasses.dataclass(frozen=True)
class AtariConfig(Config[M, D, P]):
    """Train a method on played games, then measure its score.

    Attributes:
        level: Game: Breakout, Qbert, Pong or Seaquest; "all" for all of them.
        demos: Games to learn from, at most; see `--transitions`.
        demonstrations: Folder of DQN-Replay's files to train on, instead of data/atari, where the
            program stores games of built-in demonstrators.
        episodes: Held-out games to measure the score on.
        test_seed: Seed of the first of these games.
        validation: Measure the score on validation games instead, to choose settings.
        play: Game to play instead of the game that the checkpoint's planner was trained on.
        pretrained: Evaluate the planner that comes with the library for the game, instead of
            training.
    """

    level: Annotated[str, tyro.conf.arg(name="game")]


# By domain; other domains have the names of `Config`.
SPELLINGS: Mapping[str, type[AnyConfig]] = {"gymnasium": GymnasiumConfig, "atari": AtariConfig}
