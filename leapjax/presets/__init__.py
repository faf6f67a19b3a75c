"""Presets: for each domain one module, with the configuration of every level and method.

`paper` is the paper's network and training, `leapjax` is ours. Each number of a preset stands in
one place, with its reason. Fields that a preset does not set keep the defaults of their dataclass.
"""

import functools
import importlib
from collections.abc import Callable, Mapping

from leapjax.configuration import AnyConfig
from leapjax.domains import find_domain
from leapjax.errors import UserError
from leapjax.methods import find_method
from leapjax.presets import environments

Preset = Callable[[str, str], AnyConfig]  # (level, method) -> configuration

# A module of presets is imported when it is first used: it imports its domain.
NAMES = ("babyai", "atari", "stars", "sudoku", "countdown", "satisfiability")
MODULES = {name: f"leapjax.presets.{name}" for name in NAMES}
PRESETS: dict[str, Mapping[str, Preset]] = {}  # presets of a user's own domains, by domain


def find_presets(domain: str) -> Mapping[str, Preset]:
    """Returns the presets of a domain by name; `environments` serves domains without their own.

    Raises:
        UserError: there is no such domain, or it needs an extra that is not installed.
    """
    find_domain(domain)
    if domain in PRESETS:
        return PRESETS[domain]
    if domain in MODULES:
        module = importlib.import_module(MODULES[domain])
        return {"leapjax": module.leapjax, "paper": module.paper}
    return {
        "leapjax": functools.partial(environments.leapjax, domain),
        "paper": functools.partial(environments.paper, domain),
    }


def find_preset(domain: str, level: str, method: str, name: str) -> AnyConfig:
    """Returns the configuration that a preset gives a level and a method.

    Raises:
        UserError: there is no such domain, level, method or preset.
    """
    presets = find_presets(domain)
    find_method(method)
    if name not in presets:
        raise UserError(f"unknown preset {name!r}: expected one of {', '.join(presets)}")
    return presets[name](level, method)
