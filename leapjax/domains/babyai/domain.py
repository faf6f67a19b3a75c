"""BabyAI as a `Domain`."""

import functools

import numpy as np

from leapjax.domain import (
    Augmentations,
    Demonstrations,
    Domain,
    DomainType,
    EncoderMaker,
)
from leapjax.domains.babyai import (
    augmentation,
    demonstrations,
    levels,
    observations,
    replay,
    vocabulary,
)
from leapjax.domains.babyai.adapter import ACTIONS, BabyAIAdapter
from leapjax.domains.babyai.encoders.cells import COLOURS, DIRECTIONS, OBJECTS, STATES
from leapjax.domains.babyai.encoders.context_tokens import ContextTokens
from leapjax.domains.babyai.encoders.convolutions import NORM_GROUPS
from leapjax.domains.babyai.encoders.state_tokens import StateTokens
from leapjax.domains.babyai.levels import Level
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder


def make(name: str, options: Settings) -> Domain:
    """Makes a level by name or id; makes its environment once, to read its size.

    Raises:
        UserError: the level is unknown.
    """
    level = levels.find_level(name)
    side, longest = levels.measure_level(level)

    def state_tokens(model: ModelConfig, sizes: Sizes) -> Encoder:
        del sizes
        if model.width % NORM_GROUPS:
            raise UserError(
                f"width {model.width} is not a multiple of {NORM_GROUPS}, the groups of "
                "channels that the paper's encoder normalises"
            )
        return StateTokens(side, model.width, model.dtype)

    def context_tokens(model: ModelConfig, sizes: Sizes) -> Encoder:
        del sizes
        return ContextTokens(options, model.width, model.dtype)

    encoders: dict[str, EncoderMaker] = {"leapjax": context_tokens}
    if not level.members:  # the paper's network reads grids of one side
        encoders["paper"] = state_tokens
    return Domain(
        level=level.name,
        make_adapter=lambda: BabyAIAdapter(level),
        actions=ACTIONS,
        max_steps=longest,
        blank=observations.blank(side, level.words),
        encoders=encoders,
        demonstrations=Demonstrations(
            functools.partial(demonstrations.collect, level),
            check=functools.partial(check_states, level=level),
            replay=functools.partial(replay.replay, level=level),
        ),
        augmentations=Augmentations(
            augmentation.choose_augmentations(options), augmentation.mark_needed_cells
        ),
        signature={"vocabulary": list(vocabulary.WORDS)},
        sizes={"paper": {"side": side, "words": level.words}},
        split=demonstrations.split_by_side if level.members else None,
    )


def check_states(states: Observation, where: str, level: Level) -> None:
    """Checks that the numbers of observations are in range.

    Args:
        states: observations `[n + 1, ...]` of one episode.
        where: name of the episode, for the message.
        level: level of the episode.

    Raises:
        UserError: names the numbers and their range.
    """
    side = states.grid.shape[1]
    ranges: dict[str, tuple[np.ndarray, int, int]] = {
        "grid objects": (states.grid[..., 0], 0, OBJECTS - 1),
        "grid colours": (states.grid[..., 1], 0, COLOURS - 1),
        "grid states": (states.grid[..., 2], 0, STATES - 1),
        "positions": (states.pose[:, :2], 0, side - 1),
        "directions": (states.pose[:, 2], 0, DIRECTIONS - 1),
        "goals": (states.goal, -1, side - 1),
        "instruction": (states.instruction, 0, vocabulary.SIZE - 1),
        "carried objects": (states.carried[:, 0], 0, OBJECTS - 1),
        "carried colours": (states.carried[:, 1], 0, COLOURS - 1),
    }
    for field, (values, low, high) in ranges.items():
        if values.min() < low or values.max() > high:
            raise UserError(
                f"{where}: {field} run from {values.min()} to {values.max()}, "
                f"expected {low} to {high} ({level.name})"
            )


BABYAI = DomainType(Settings, make, tuple(levels.LEVELS))
