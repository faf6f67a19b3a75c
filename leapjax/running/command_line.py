"""Makes the configurations that a command line asks for."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leapjax import pretrained
from leapjax.configuration import AnyConfig, Config, change
from leapjax.data import storage
from leapjax.data.storage import Described
from leapjax.domains import check_imported, find_domain
from leapjax.errors import UserError
from leapjax.methods import METHODS, find_method
from leapjax.presets import find_preset
from leapjax.pretrained import GROUPS, Specification
from leapjax.running import shell, startup
from leapjax.running.limits import check


def parse(
    domain: str,
    arguments: Sequence[str],
    kind: type[AnyConfig] = Config,
    module: str = "experiments",
) -> list[AnyConfig]:
    """One configuration per level and method from a command line; exits with 2 if it is bad.

    Args:
        domain: by name.
        arguments: of the command line.
        kind: `Config`, or a subclass with the program's own names of options.
        module: of the program, for usage lines.

    Raises:
        UserError: an unknown level, method or preset, or options that cannot be.
    """
    shell.check_values(arguments)
    # These come first: they decide the defaults of all the rest, and of --help.
    command = startup.command(module)
    several = argparse.ArgumentParser(command, add_help=False, allow_abbrev=False)
    several.add_argument("--method", nargs="*")
    named, others = several.parse_known_args(list(arguments))
    first = argparse.ArgumentParser(command, add_help=False, allow_abbrev=False)
    for field in ("level", "preset", "checkpoint", "demonstrations", "demos"):
        first.add_argument(kind.flag(field), dest=field)
    first.add_argument("--pretrained", action="store_true")
    chosen, _ = first.parse_known_args(others)
    folder = None if chosen.checkpoint is None else Path(chosen.checkpoint)
    if folder is not None and chosen.pretrained:
        raise UserError("--checkpoint and --pretrained: give one of them")
    trained = None if folder is None else pretrained.read_specification(folder)
    levels = find_domain(domain).levels
    data = storage.described(chosen.demonstrations) if chosen.demonstrations else Described()
    level = chosen.level or (trained.level if trained else data.level or levels[0])
    if not chosen.level:
        check_imported(level, str(folder or chosen.demonstrations))
    methods = None if named.method is None else find_methods(named.method)
    if methods and len(methods) > 1 and (folder is not None or chosen.pretrained):
        raise UserError(
            f"--method {' '.join(named.method)}: a planner that is trained already is of one method"
        )
    configs = []
    for each in levels if level == "all" else [level]:
        if chosen.pretrained:
            folder = pretrained.published(each)
            trained = pretrained.read_specification(folder)
        name = chosen.preset or (trained.origin.preset if trained else Config.preset)
        for method in methods or [trained.method if trained else Config.method]:
            default = as_kind(kind, find_preset(domain, each, method, name))
            if data.episodes is not None and chosen.demos is None:  # as many as there are
                default = dataclasses.replace(default, demos=min(default.demos, data.episodes))
            if trained and (trained.domain, trained.method) == (domain, method):
                default = _as_trained(default, trained)
            # Which options there are depends on the method: usage lines name it.
            shown = f"{module} --method {method}" if methods else module
            given = _parse(["--method", method, *others], default, shown)
            if methods and len(methods) > 1 and not default.training.steps:
                # --steps is for those that learn.
                given = change(given, training={"steps": 0})
            config = dataclasses.replace(given, level=each, method=method, checkpoint=folder)
            check(config)
            configs.append(config)
    return configs


def as_kind(kind: type[AnyConfig], config: AnyConfig) -> AnyConfig:
    """Returns the same configuration as a program's own subclass of `Config`."""
    return kind(**{each.name: getattr(config, each.name) for each in dataclasses.fields(config)})


def find_methods(names: Sequence[str]) -> list[str]:
    """The methods that a command line names, each once.

    Args:
        names: of methods; "all" stands for those that fit every domain.

    Raises:
        UserError: an unknown method, or none.
    """
    every = [name for name in METHODS if METHODS[name].everywhere]
    if not names:
        raise UserError(f"--method needs a name: some of {', '.join(METHODS)}, or all")
    for name in names:
        if name != "all":
            find_method(name)
    found = [each for name in names for each in (every if name == "all" else [name])]
    return list(dict.fromkeys(found))


def _as_trained(default: AnyConfig, trained: Specification) -> AnyConfig:
    """Defaults that are what an earlier run has."""
    return dataclasses.replace(
        default,
        **{group: getattr(trained, group) for group in GROUPS},
        context=trained.context,
        seeds=(trained.origin.seed,),
        demos=trained.origin.demos,
        demonstrations=trained.origin.demonstrations,
    )


def _parse(arguments: Sequence[str], default: AnyConfig, module: str) -> AnyConfig:
    # Which options there are depends on the method and the domain.
    groups = ("method_settings", "domain_settings", "planner")
    settings = tuple(type(getattr(default, group)) for group in groups)
    generic: Any = type(default)
    try:
        return shell.parse(generic[settings], module, arguments, default=default)
    except ValueError as error:  # the dataclasses refuse values that cannot be
        raise UserError(str(error)) from None
