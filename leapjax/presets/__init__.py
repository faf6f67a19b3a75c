"""Presets: for each domain one module, with the configuration of every level and method.

`paper` is the paper's network and training, `leapjax` is ours. A number of a preset stands in one
place, with its reason; what a preset does not set is the default of the dataclass that has it.
"""

import functools
from collections.abc import Callable, Mapping

from leapjax.domains import find_domain
from leapjax.errors import UserError
from leapjax.methods import find_method
from leapjax.presets import atari, babyai, environments, stars, sudoku
from leapjax.running.config import AnyConfig

Preset = Callable[[str, str], AnyConfig]  # (level, method) -> configuration

PRESETS: dict[str, Mapping[str, Preset]] = {
    "babyai": {"leapjax": babyai.leapjax, "paper": babyai.paper},
    "atari": {"leapjax": atari.leapjax, "paper": atari.paper},
    "stars": {"leapjax": stars.leapjax, "paper": stars.paper},
    "sudoku": {"leapjax": sudoku.leapjax, "paper": sudoku.paper},
}


def find_preset(domain: str, level: str, method: str, name: str) -> AnyConfig:
    """Returns the configuration that a preset gives a level and a method.

    A domain that is not in `PRESETS` has those of any environment.

    Raises:
        UserError: there is no such domain, level, method or preset.
    """
    find_domain(domain)
    find_method(method)
    presets = PRESETS.get(domain) or {
        "leapjax": functools.partial(environments.leapjax, domain),
        "paper": functools.partial(environments.paper, domain),
    }
    if name not in presets:
        raise UserError(f"unknown preset {name!r}: expected one of {', '.join(sorted(presets))}")
    return presets[name](level, method)
