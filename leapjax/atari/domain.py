"""The games of Atari as a `Domain`."""

import dataclasses
import functools
import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from leapjax.atari import replay
from leapjax.atari.augmentation import mirrored, shifted
from leapjax.atari.encoders import STACK, CurrentTokens, StateTokens
from leapjax.atari.games import FRAME_SKIP, GAMES, HEIGHT, MAX_STEPS, WIDTH, Game, find_game
from leapjax.checks import check_at_least, check_types, check_within
from leapjax.data.seeds import MAX_TRAINING_SEED
from leapjax.domain import Collection, Domain, DomainType, Source
from leapjax.environments import Adapter
from leapjax.errors import UserError
from leapjax.models.encoder import Encoder
from leapjax.models.trajectory import ModelConfig

LONGEST = 5_000  # decisions of a game of preset `leapjax`: as long as those that are learned from
FOLDER = "data/atari"  # where demonstrations are, in the format of DQN-Replay
MOST_STEPS = (2**31 - 1) // FRAME_SKIP  # the emulator counts frames in 32 bits
TOKENS = 4  # of a state, of our encoder
TEST_SEED = 20_000_000  # of the first game; some before it helped to choose the data


@dataclasses.dataclass(frozen=True)
class Settings:
    """Atari: data, games and augmentation."""

    transitions: int = 50_000  # to learn from, by whole trajectories
    replay_run: int = 1  # of the runs that DQN-Replay has of each game
    sticky: float = 0.0  # the probability that a game repeats the last action, not the new one
    max_steps: int = MAX_STEPS  # of a game: then it is cut off
    features: int = 32  # of the first convolution; the others have twice as many
    mirror: bool = False  # show every other window in a mirror, to learn from more
    shift: int = 0  # move all frames of a window by at most so many pixels, to learn from more

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "transitions")
        check_at_least(self, 1, "replay_run", most=MAX_TRAINING_SEED)  # each has seeds of its own
        check_at_least(self, 1, "features", most=10_000)
        check_at_least(self, 1, "max_steps", most=MOST_STEPS)
        check_at_least(self, 0, "shift", most=WIDTH - 1)
        check_within(self, 0, 1, "sticky")


def make(name: str, settings: Settings) -> Domain:
    """A game by its name.

    Raises:
        UserError: there is none, or ale-py is not installed.
    """
    game = find_game(name)
    if importlib.util.find_spec("ale_py") is None:
        raise UserError("Atari needs ale-py, which is missing: pip install 'leapjax[atari]'")

    def make_adapter() -> Adapter:
        from leapjax.atari.adapter import AtariAdapter  # noqa: PLC0415  (ale-py is optional)

        return AtariAdapter(game, settings.sticky, settings.max_steps)

    def state_tokens(model: ModelConfig, context: int) -> Encoder:
        del context
        return StateTokens(model.width, settings.features, model.dtype)

    def current_tokens(model: ModelConfig, context: int) -> Encoder:
        del context
        return CurrentTokens(model.width, settings.features, TOKENS, model.dtype)

    mirror = functools.partial(mirrored, mirror=game.mirror, actions=game.actions)
    shift = functools.partial(shifted, most=settings.shift)
    return Domain(
        level=name,
        make_adapter=make_adapter,
        collect=None,  # by transitions, not by episodes: see `source`
        actions=(*game.actions, "end"),
        max_steps=settings.max_steps,
        blank=np.zeros((HEIGHT, WIDTH), np.uint8),
        encoders={"paper": state_tokens, "leapjax": current_tokens},
        augmentations=[mirror] * settings.mirror + [shift] * (settings.shift > 0),
        source=source(game, settings),
        return_scale=game.return_scale,
        signature={"actions": list(game.actions)},
    )


def source(game: Game, settings: Settings) -> Source:
    """Where the trajectories of a game come from."""
    count, run = settings.transitions, settings.replay_run

    def load(where: str, seed: int) -> Collection:
        from leapjax.atari.collect import shards  # noqa: PLC0415  (ale-py is optional)

        ours = shards(Path(where), game, count, run)
        found = replay.read(Path(where), game, count, seed, run, ours)
        held = sum(len(each.actions) for each in found.demonstrations)
        if held < count:
            raise UserError(
                f"{where} holds {held} transitions of {game.name}, fewer than --transitions "
                f"{count}: use --transitions {held}"
            )
        return found

    def write(where: str, progress: Callable[[int], None]) -> str:
        from leapjax.atari.collect import collect  # noqa: PLC0415  (so)

        collect(Path(where), game, count, run, LONGEST, progress=progress)
        return f"{count} transitions of {game.name} in {where}"

    def exists(where: str) -> bool:
        from leapjax.atari.collect import is_whole  # noqa: PLC0415  (so)

        return is_whole(Path(where), game, count, run, LONGEST)

    return Source(FOLDER, exists, write, load, count, "transitions")


# By game: T, N and the batch (paper, tables 6 and 8).
PAPER = {
    "Breakout": (5, 10, 64), "Qbert": (5, 10, 64), "Pong": (5, 10, 256), "Seaquest": (10, 30, 128),
}  # fmt: skip
EPOCHS = 10
TRANSITIONS = {"Seaquest": 200_000}  # to learn from with preset `leapjax`, where not as elsewhere
IMITATORS = ("leap", "bc", "dt")  # they sample what to do; to ask for a ball can be improbable


def preset(name: str, preset: str) -> Mapping[str, Any]:
    """What a preset sets for a game.

    Raises:
        UserError: an unknown game.
    """
    find_game(name)
    shared = {
        "executed": 1, "episodes": 20, "test_seed": TEST_SEED, "demos": 100_000,  # all there are
    }  # fmt: skip
    if preset == "paper":
        horizon, iterations, batch = PAPER[name]
        transitions = 500_000
        return {
            **shared, "transitions": transitions, "steps": EPOCHS * transitions // batch,
            "context": 25, "horizon": horizon, "iterations": iterations, "batch": batch,
            "layers": 6, "heads": 8, "attention": "causal",
        }  # fmt: skip
    return {
        **shared, "context": STACK - 1, "horizon": 5, "iterations": 5, "steps": 10_000,
        "layers": 2, "width": 64, "features": 16, "mirror": True, "max_steps": LONGEST,
        "transitions": TRANSITIONS.get(name, Settings.transitions),
    }  # fmt: skip


def data_name(game: str, transitions: int) -> str:
    """What data of a game are recorded as: its name, where there are as many as usual."""
    usual = preset(game, "leapjax")["transitions"]
    return game if transitions == usual else f"{game}, {transitions:,} transitions"


def game_of(name: str) -> str:
    """The game of data that `data_name` calls so."""
    return name.partition(",")[0]


def tuned(name: str, method: str, preset: str) -> Mapping[str, Any]:
    """What a game changes of a method's own options."""
    game = find_game(name)
    options: dict[str, Any] = {"windows": "step"}
    if method in ("leap", "dt"):
        options["target_return"] = game.target
    if method == "leap":
        options |= {"end": False, "returns": True}
        if preset == "paper":
            options |= {"masking": "one", "microbatch": 0}
        else:  # to read frames costs more than to look at a plan in T ways
            options["masking"] = "stratified"
    if preset == "leapjax":
        options["learning_rate"] = 1e-3
    if method in IMITATORS:
        options["temperature"] = 0.1 if preset == "leapjax" else 1.0
        if preset == "leapjax" and name == "Seaquest":
            # What moves there looks where it goes. Who imitates and sees the past learns to go on
            # as before (docs/tried.md).
            options["context"] = 0
    if method == "cql" and preset == "leapjax":
        options["alpha"] = 1.0  # with less it learns nothing in so few steps (docs/tried.md)
    return options


ATARI = DomainType(Settings, make, tuple(GAMES), preset, tuned)
