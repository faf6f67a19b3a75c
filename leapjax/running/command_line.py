"""Makes the configurations that a command line asks for."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from leapjax import pretrained
from leapjax.configuration import AnyConfig, Config, change
from leapjax.data import storage
from leapjax.data.storage import Described
from leapjax.domains import check_imported, find_domain
from leapjax.errors import UserError
from leapjax.methods import METHODS, find_method
from leapjax.presets import find_preset
from leapjax.pretrained import GROUPS, Specification
from leapjax.running import shell
from leapjax.running.limits import check


@dataclasses.dataclass(frozen=True)
class Choice:
    """The options that decide the defaults of all other options, and the text of --help.

    An option that the command line lacks is `None`.

    Attributes:
        level: name or id of a level, or "all".
        method: names of methods.
        preset: name of a preset.
        checkpoint: folder of a trained planner.
        demonstrations: id of a data set.
        pretrained: whether to play the planners that come with the library.
    """

    level: str | None = None
    method: tuple[str, ...] | None = None
    preset: str | None = None
    checkpoint: Path | None = None
    demonstrations: str | None = None
    pretrained: bool = False


def parse(
    domain: str,
    arguments: Sequence[str],
    kind: type[AnyConfig] = Config,
    module: str = "experiments",
) -> list[AnyConfig]:
    """Returns one configuration for each level and method; exits with 2 if an option is wrong.

    Args:
        domain: name of the domain.
        arguments: command line.
        kind: `Config`, or a subclass with the program's own names of options.
        module: module of the program, for usage lines.

    Raises:
        UserError: a level, method or preset is unknown, or a configuration cannot work.
    """
    shell.check_values(arguments)
    choice, others = choose(kind, arguments)
    data = storage.describe_dataset(choice.demonstrations) if choice.demonstrations else Described()
    methods, folder = choose_methods(choice), choice.checkpoint
    trained = None if folder is None else pretrained.read_specification(folder)
    configs = []
    for level in choose_levels(domain, choice, data, trained):
        learned = level
        if choice.pretrained:
            folder = pretrained.find_published(level)
            trained = pretrained.read_specification(folder)
            learned = trained.level  # of a family: all of its levels
        for method in methods or [trained.method if trained else Config.method]:
            default = make_default(kind, domain, learned, method, choice, data, trained)
            play = None if learned == level else level
            default = dataclasses.replace(default, checkpoint=folder, play=play)
            # Methods have different options: usage lines name the method.
            shown = f"{module} --method {method}" if methods else module
            config = override(default, others, shown)
            if methods and len(methods) > 1 and not default.training.steps:
                config = change(config, training={"steps": 0})  # this method does not learn
            check(config)
            if trained is not None and len(config.seeds) > 1:
                raise UserError(
                    f"{kind.flag('seeds')} {' '.join(map(str, config.seeds))}: a planner that is "
                    "trained already is of one seed"
                )
            configs.append(config)
    return configs


def choose(kind: type[AnyConfig], arguments: Sequence[str]) -> tuple[Choice, list[str]]:
    """Reads the choice from a command line; returns it with the other arguments.

    Args:
        kind: `Config`, or a subclass with the program's own names of options.
        arguments: command line.

    Raises:
        UserError: the command line asks for both a checkpoint and a published planner.
    """
    fields = [
        (each.name, Annotated[each.type, tyro.conf.arg(name=kind.flag(each.name)[2:])], each)
        for each in dataclasses.fields(Choice)
    ]
    spelled = dataclasses.make_dataclass("Choice", fields, bases=(Choice,), frozen=True)
    choice: Choice
    choice, others = tyro.cli(
        spelled, args=list(arguments), return_unknown_args=True, add_help=False
    )
    if choice.checkpoint is not None and choice.pretrained:
        raise UserError("--checkpoint and --pretrained: give one of them")
    return choice, others


def choose_levels(
    domain: str, choice: Choice, data: Described, trained: Specification | None
) -> Sequence[str]:
    """Returns the levels to run: the named ones, or the level of the checkpoint or data set.

    Args:
        domain: name of the domain; its first level is the default.
        choice: options of the command line.
        data: metadata of the data set that the command line names.
        trained: specification of the checkpoint that the command line names.

    Raises:
        UserError: the domain is unknown, or only a file names the module of the level.
    """
    levels = find_domain(domain).levels
    if choice.level is not None:
        return levels if choice.level == "all" else [choice.level]
    level = trained.level if trained else data.level or levels[0]
    check_imported(level, str(choice.checkpoint or choice.demonstrations))
    return [level]


def choose_methods(choice: Choice) -> list[str] | None:
    """Returns the methods that a command line names, each once; `None` without --method.

    "all" stands for the methods that fit every domain.

    Raises:
        UserError: a method is unknown, the list is empty, or it has several methods for a trained
            planner.
    """
    if choice.method is None:
        return None
    if not choice.method:
        raise UserError(f"--method needs a name: some of {', '.join(METHODS)}, or all")
    for name in choice.method:
        if name != "all":
            find_method(name)
    every = [name for name in METHODS if METHODS[name].everywhere]
    found = [each for name in choice.method for each in (every if name == "all" else [name])]
    methods = list(dict.fromkeys(found))
    if len(methods) > 1 and (choice.checkpoint is not None or choice.pretrained):
        raise UserError(
            f"--method {' '.join(choice.method)}: a planner that is trained already is of one "
            "method"
        )
    return methods


def make_default(
    kind: type[AnyConfig],
    domain: str,
    level: str,
    method: str,
    choice: Choice,
    data: Described,
    trained: Specification | None,
) -> AnyConfig:
    """Returns the defaults of all options for one level and method.

    Args:
        kind: `Config`, or a subclass with the program's own names of options.
        domain: name of the domain.
        level: name or id of the level.
        method: name of the method.
        choice: options of the command line.
        data: metadata of the data set that the command line names.
        trained: specification of the trained planner, or `None`; its settings become the defaults.

    Raises:
        UserError: the level, method or preset is unknown.
    """
    name = choice.preset or (trained.origin.preset if trained else Config.preset)
    preset = find_preset(domain, level, method, name)
    default = kind(**{each.name: getattr(preset, each.name) for each in dataclasses.fields(preset)})
    if data.episodes is not None:
        default = dataclasses.replace(default, demos=min(default.demos, data.episodes))
    if trained and (trained.domain, trained.method) == (domain, method):
        default = dataclasses.replace(
            default,
            **{group: getattr(trained, group) for group in GROUPS},
            context=trained.context,
            seeds=(trained.origin.seed,),
            demos=trained.origin.demos,
            demonstrations=trained.origin.demonstrations,
        )
    return dataclasses.replace(
        default,
        level=level,
        method=method,
        preset=name,
        demonstrations=choice.demonstrations or default.demonstrations,
        pretrained=choice.pretrained,
    )


def override(default: AnyConfig, arguments: Sequence[str], module: str) -> AnyConfig:
    """Returns a configuration with the options of a command line in place of the defaults.

    Args:
        default: configuration without these options.
        arguments: command line without the options of `Choice`.
        module: module of the program, for usage lines.

    Raises:
        UserError: a value is out of its range.
    """
    # The types of these fields, and so the options, depend on the method and the domain.
    groups = ("method_settings", "domain_settings", "planner")
    settings = tuple(type(getattr(default, group)) for group in groups)
    generic: Any = type(default)
    try:
        return shell.parse(generic[settings], module, arguments, default=default)
    except ValueError as error:  # a dataclass refuses a value
        raise UserError(str(error)) from None
