"""The games of Atari as a `Domain`."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from leapjax.checks import check_at_least, check_types, check_within
from leapjax.data.seeds import MAX_TRAINING_SEED
from leapjax.domain import (
    Augmentations,
    Collection,
    Demonstrations,
    Domain,
    DomainType,
    Scaling,
    Source,
)
from leapjax.domains.atari import replay
from leapjax.domains.atari.augmentation import mirror_window
from leapjax.domains.atari.encoders import CurrentTokens, StateTokens
from leapjax.domains.atari.games import FRAME_SKIP, GAMES, HEIGHT, MAX_STEPS, WIDTH, Game, find_game
from leapjax.environments import Adapter
from leapjax.errors import UserError
from leapjax.extras import report_missing
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder

LONGEST = 5_000  # most decisions of a game in the demonstrations and with preset `leapjax`
FOLDER = "data/atari"  # folder of demonstrations in the format of DQN-Replay
MOST_STEPS = (2**31 - 1) // FRAME_SKIP  # the emulator counts frames in 32 bits
TOKENS = 4  # tokens of a state in our encoder


@dataclasses.dataclass(frozen=True)
class Settings:
    """Atari: data, games and augmentation.

    Attributes:
        transitions: Transitions to learn from; whole games are sampled until there are enough.
        dqn_seed: Seed of the DQN whose games to learn from; DQN-Replay has 1 to 5 of each game.
        sticky: Probability that the game repeats the last action in place of the new one.
        max_steps: Decisions after which a game is cut off.
        features: Features of the first convolution; later convolutions have twice as many.
        mirror: Reflect half of the training windows at random, with their actions.
    """

    transitions: int = 50_000
    dqn_seed: int = 1
    sticky: float = 0.0
    max_steps: int = MAX_STEPS
    features: int = 32
    mirror: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "transitions")
        check_at_least(self, 1, "dqn_seed", most=MAX_TRAINING_SEED)  # each has its own games
        check_at_least(self, 1, "features", most=10_000)
        check_at_least(self, 1, "max_steps", most=MOST_STEPS)
        check_within(self, 0, 1, "sticky")


def make(name: str, settings: Settings) -> Domain:
    """Makes a game by its name.

    Raises:
        UserError: the game is unknown, or ale-py is not installed.
    """
    game = find_game(name)
    with report_missing("atari"):
        import ale_py  # noqa: F401, PLC0415  (reports now if it is missing)

    def make_adapter() -> Adapter:
        from leapjax.domains.atari.adapter import AtariAdapter  # noqa: PLC0415  (ale-py is optional)

        return AtariAdapter(game, settings.sticky, settings.max_steps)

    def state_tokens(model: ModelConfig, sizes: Sizes) -> Encoder:
        del sizes
        return StateTokens(model.width, settings.features, model.dtype)

    def current_tokens(model: ModelConfig, sizes: Sizes) -> Encoder:
        del sizes
        return CurrentTokens(model.width, settings.features, TOKENS, model.dtype)

    mirror = functools.partial(mirror_window, mirror=game.mirror, actions=game.actions)
    return Domain(
        level=name,
        make_adapter=make_adapter,
        actions=(*game.actions, "end"),
        max_steps=settings.max_steps,
        blank=np.zeros((HEIGHT, WIDTH), np.uint8),
        encoders={"paper": state_tokens, "leapjax": current_tokens},
        demonstrations=Demonstrations(source=make_source(game, settings)),
        augmentations=Augmentations([mirror] * settings.mirror),
        scaling=Scaling(returns=game.return_scale),
        signature={"actions": list(game.actions)},
    )


def make_source(game: Game, settings: Settings) -> Source:
    """Makes the source of a game's trajectories, counted in transitions."""
    count, dqn_seed = settings.transitions, settings.dqn_seed

    def load(where: str, seed: int) -> Collection:
        from leapjax.domains.atari.demonstrators.collect import find_shards  # noqa: PLC0415  (ale-py is optional)

        ours = find_shards(Path(where), game, count, dqn_seed)
        found = replay.read(Path(where), game, count, seed, dqn_seed, ours)
        held = sum(len(each.actions) for each in found.demonstrations)
        if held < count:
            raise UserError(
                f"{where} holds {held} transitions of {game.name}, fewer than {count}: ask for "
                f"{held}",
                "transitions",
            )
        return found

    def write(where: str, progress: Callable[[int], None]) -> str:
        from leapjax.domains.atari.demonstrators.collect import collect  # noqa: PLC0415  (ale-py is optional)

        collect(Path(where), game, count, dqn_seed, LONGEST, progress=progress)
        return f"{count} transitions of {game.name} in {where}"

    def exists(where: str) -> bool:
        from leapjax.domains.atari.demonstrators.collect import is_whole  # noqa: PLC0415  (ale-py is optional)

        return is_whole(Path(where), game, count, dqn_seed, LONGEST)

    return Source(FOLDER, exists, write, load, count, "transitions")


ATARI = DomainType(Settings, make, tuple(GAMES))
