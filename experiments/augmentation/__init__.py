"""BabyAI with more augmentation, for models that plan where no demonstration leads.

`lookalikes` adds objects that resemble the target; `false_starts` and `detours` add moves before
a window. `experiments.properties` trains with them.
"""

import dataclasses

from experiments.augmentation.detours import add_detour
from experiments.augmentation.false_starts import add_false_start
from experiments.augmentation.lookalikes import add_lookalikes
from leapjax.checks import check_within
from leapjax.configuration import AnyConfig
from leapjax.domain import Augmentation, Domain, DomainType
from leapjax.domains import DOMAINS
from leapjax.domains.babyai import domain, settings
from leapjax.domains.babyai.augmentation import choose_augmentations
from leapjax.domains.babyai.augmentation.words import find_words
from leapjax.presets import PRESETS, find_presets

NAME = "augmented_babyai"  # in the table of domains


@dataclasses.dataclass(frozen=True)
class Settings(settings.Settings):
    """BabyAI's settings, and augmentation that follows constraints and obstacles.

    Attributes:
        lookalikes: Clutter may share the kind or the colour of the target.
        false_starts: Share of training windows that begin with random moves, in 0 .. 1. It needs a
            context of 0.
        detours: Share of training windows that lead around obstacles, in 0 .. 1. It needs a context
            of 0.
    """

    lookalikes: bool = False
    false_starts: float = 0.0
    detours: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_within(self, 0, 1, "false_starts", "detours")


def make(level: str, options: Settings) -> Domain:
    """Makes a level of BabyAI whose training windows are augmented further.

    Raises:
        UserError: the level is unknown.
    """
    plain = domain.make(level, options)
    return plain._replace(augmentations=plain.augmentations._replace(functions=choose(options)))


def choose(options: Settings) -> list[Augmentation]:
    """Returns the augmentations that the settings ask for; the last of them is applied first."""
    words = find_words()
    symmetries = choose_augmentations(dataclasses.replace(options, clutter=0.0))
    clutter = choose_augmentations(dataclasses.replace(options, augment=False))
    found = [*symmetries]
    if options.false_starts:
        found.append(lambda key, w: add_false_start(key, w, options.false_starts))
    if options.detours:
        found.append(lambda key, w: add_detour(key, w, options.detours, words))
    if options.lookalikes and options.clutter:
        return [*found, lambda key, w: add_lookalikes(key, w, options.clutter, words)]
    return [*found, *clutter]


def augment(config: AnyConfig, **changes: float) -> AnyConfig:
    """Returns BabyAI's configuration with some of these augmentations, by their fields."""
    options = Settings(**{**dataclasses.asdict(config.domain_settings), **changes})
    return dataclasses.replace(config, domain=NAME, domain_settings=options)


DOMAINS[NAME] = DomainType(Settings, make, domain.BABYAI.levels)
PRESETS[NAME] = find_presets("babyai")
