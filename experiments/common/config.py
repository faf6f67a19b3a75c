"""The configuration of a run: presets, the command line, the hash that names it."""

import argparse
import dataclasses
import hashlib
import json
import math
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import jax
import tyro

from experiments.common import loggers, memory, program, startup
from experiments.common.runtime import Cluster
from leapjax import checkpoints, configurations, pretrained
from leapjax.agents.learning import TrainingConfig
from leapjax.checks import check_integer, check_number
from leapjax.data import seeds, storage
from leapjax.data.seeds import UNSEEN
from leapjax.data.storage import Described
from leapjax.domain import Domain
from leapjax.domains import check_imported, find_domain
from leapjax.errors import UserError
from leapjax.fitting import names_of, preset_options
from leapjax.methods import METHODS, find_method
from leapjax.models.trajectory import ModelConfig
from leapjax.planners import GibbsConfig
from leapjax.pretrained import GROUPS, Origin, Specification
from leapjax.rollouts import MOST_OPEN

M = TypeVar("M")
D = TypeVar("D")
P = TypeVar("P")


# A program that calls options otherwise has a subclass, which annotates their fields.
@dataclasses.dataclass(frozen=True)
class Config(Generic[M, D, P]):
    """Train a method on demonstrations of a level, then measure its success.

    Attributes:
        level: Level by its name or id, or "all" for those of the paper.
        method: How to learn and to act, one or more of: leap, classifier, bc, dt, bcq, iql, mopo,
            plate, cql, qr_dqn, rem, rules, random; or "all" for those that fit every level.
        preset: Defaults of all other options: "leapjax" for ours, "paper" for the paper's.
        seeds: Training seeds; each draws its own demonstrations.
        demos: Demonstrations to train on; of a given data set at most those that it has.
        demonstrations: Id of a Minari data set to train on, in place of demonstrations that are
            made for the level; the level follows from it if the data set names one.
        episodes: Held-out episodes to measure success on.
        test_seed: Level seed of the first of these episodes.
        validation: Measure success on validation levels instead, to choose settings.
        context: K, past steps that the planner sees.
        executed: Actions to execute before replanning; None for the whole plan, as in the paper.
        rules: Weight of the level's own rules in the energy while planning; 0 leaves them out.
        checkpoint: Folder of an earlier run to evaluate instead of training. Its settings become
            the defaults, except those of `--executed` and `--rules`.
        play: Level to play instead of the one that the planner of a checkpoint was trained on.
        pretrained: Evaluate the planner that comes with the library for the level, instead of
            training.
        record: Append the row to results/, which is committed, and skip what is recorded already.
        force: With `--record`: run again what is recorded, and replace its row.
        runs: Folder for checkpoints, metrics, plots and unrecorded rows.
        pictures: Draw the plots and the animation.
        loggers: Where measurements also go: "tensorboard", "wandb" (offline, unless WANDB_MODE says
            otherwise).
        checkpoint_seconds: Seconds between checkpoints, which a killed run can lose at most (a run
            of several processes: and up to 20 steps more).
    """

    method_settings: Annotated[M, tyro.conf.arg(name="")]
    domain_settings: Annotated[D, tyro.conf.arg(name="")]
    planner: Annotated[P, tyro.conf.arg(name="")]
    domain: Annotated[str, tyro.conf.Suppress]
    level: str
    method: Annotated[str, tyro.conf.arg(metavar="STR [STR ...]")] = "leap"
    preset: str = "leapjax"
    seeds: tuple[int, ...] = (0,)
    demos: int = 500
    demonstrations: str | None = None
    episodes: int = 200
    test_seed: int = UNSEEN
    validation: bool = False
    context: int = 0
    executed: int | None = None
    rules: float = 0.0
    checkpoint: Path | None = None
    play: str | None = None
    pretrained: bool = False
    record: bool = False
    force: bool = False
    runs: Path = Path("runs")
    pictures: bool = True
    loggers: tuple[str, ...] = ()
    checkpoint_seconds: float = 30.0
    model: Annotated[ModelConfig, tyro.conf.arg(name="")] = ModelConfig()
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = TrainingConfig()
    cluster: Annotated[Cluster, tyro.conf.arg(name="")] = Cluster()

    @classmethod
    def flag(cls, field: str) -> str:
        """What the command line calls a field, such as "--level"."""
        hint = typing.get_type_hints(cls, include_extras=True)[field]
        names = [getattr(each, "name", None) for each in getattr(hint, "__metadata__", ())]
        return f"--{next(filter(None, names), field)}"


AnyConfig = Config[Any, Any, Any]  # of whatever method, domain and planner

# Plans that are made together in a run. One program is soon compiled. Larger chunks are a tenth
# faster, and the last episodes of an evaluation would rather have smaller ones.
PLANS_TOGETHER = 32
OUTCOME = 320  # bytes of an episode that is over, while all are gathered and written
COPYING = ("each", "stratified")  # ways to mask that make T copies of a window

# What a result does not depend on, or what its row holds on its own.
_NOT_HASHED = (
    "seeds", "checkpoint", "pretrained", "record", "force", "runs", "pictures",
    "checkpoint_seconds", "cluster", "loggers",
)  # fmt: skip


def blank(domain: str, level: str, method: str, kind: type[AnyConfig] = Config) -> AnyConfig:
    """The defaults of every option, before any preset.

    Raises:
        UserError: an unknown domain or method.
    """
    chosen = find_method(method)
    settings = chosen.settings(), find_domain(domain).settings(), chosen.planner()
    return kind(*settings, domain, level, method)


def preset(
    domain: str, level: str, method: str, name: str, kind: type[AnyConfig] = Config
) -> AnyConfig:
    """The defaults of a preset: the level's, then the method's, then the level's for the method.

    Raises:
        UserError: an unknown domain, level, method or preset.
    """
    config = dataclasses.replace(blank(domain, level, method, kind), preset=name)
    return with_options(config, preset_options(domain, level, method, name))


def with_options(config: AnyConfig, options: Mapping[str, Any]) -> AnyConfig:
    """A configuration with some options changed, by the names that the command line has."""
    changed: dict[str, Any] = {}
    for group in GROUPS:
        part = getattr(config, group)
        names = names_of(type(part))
        mine = {name: value for name, value in options.items() if name in names}
        changed[group] = dataclasses.replace(part, **mine)
        options = {name: value for name, value in options.items() if name not in names}
    return dataclasses.replace(config, **changed, **options)


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
    program.check_values(arguments)
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
            default = preset(domain, each, method, name, kind)
            if data.episodes is not None and chosen.demos is None:  # as many as there are
                default = dataclasses.replace(default, demos=min(default.demos, data.episodes))
            if trained and (trained.domain, trained.method) == (domain, method):
                default = _as_trained(default, trained)
            given = _parse(["--method", method, *others], default, module)
            if methods and len(methods) > 1 and not default.training.steps:
                # --steps is for those that learn.
                given = with_options(given, {"steps": 0})
            config = dataclasses.replace(given, level=each, method=method, checkpoint=folder)
            check(config)
            configs.append(config)
    return configs


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
        return program.parse(generic[settings], module, arguments, default=default)
    except ValueError as error:  # the dataclasses refuse values that cannot be
        raise UserError(str(error)) from None


def check(config: AnyConfig) -> None:
    """Refuses what cannot work before any long work starts.

    Raises:
        UserError: says what.
    """
    check_counts(config, "episodes")
    if config.training.steps and config.demos < 1:
        raise UserError(
            f"--demos must be at least 1, got {config.demos}: --steps {config.training.steps} "
            "needs demonstrations to train on, and a method that learns nothing has none by default"
        )
    check_seeds(config.seeds)
    episode_seeds(config)
    if not 0 <= config.demos <= seeds.TRAINING_STRIDE:
        raise UserError(f"--demos {config.demos}: at most {seeds.TRAINING_STRIDE} are possible")
    loggers.check(config.loggers)
    if config.checkpoint_seconds != math.inf:  # never before the end
        check_number("--checkpoint-seconds", config.checkpoint_seconds, 0)
    check_integer("--context", config.context)
    check_number("--rules", config.rules, 0)
    check_executed(config.executed, config.planner.horizon)
    check_target_return(config)
    checkpoints.check_path(config.runs)
    if config.play is not None and config.checkpoint is None:
        raise UserError("--play: another level is played with a --checkpoint, and there is none")
    recorded = storage.described(config.demonstrations).level if config.demonstrations else None
    # `module:id` is an environment that a module registers; data know it by its id.
    if recorded is not None and recorded != config.level.rpartition(":")[2]:
        raise UserError(
            f"{config.flag('demonstrations')} {config.demonstrations} is of {recorded}, not of "
            f"{config.level}: use {config.flag('level')} {recorded}"
        )
    domain = make_domain(config)
    made = config.demonstrations is None and config.checkpoint is None and config.demos > 0
    if made and domain.collect is None and domain.source is None:
        raise UserError(f"{storage.no_demonstrator(domain)} ({config.flag('demonstrations')})")
    if config.rules and domain.rules is None:
        raise UserError(f"--rules: {config.level} has no rules that are written as an energy")
    limit = domain.shortest_limit
    if limit is not None and config.planner.horizon > limit:
        raise UserError(
            f"--horizon {config.planner.horizon} is longer than an episode of {config.level} "
            f"may last: its step limit is {limit}"
        )
    if config.checkpoint is None and config.context > domain.max_steps:
        raise UserError(
            f"--context {config.context} is longer than any episode of {config.level}: at most "
            f"{domain.max_steps} steps come before a state"
        )
    check_memory(config, domain)
    # An agent costs nothing to make, and says what its method cannot do.
    agent = pretrained.make_agent(specify(config, config.seeds[0], domain), domain)
    fill = getattr(config.planner, "fill", "together")
    if not agent.energy.accepts_mask and fill != "together":
        raise UserError(
            f"--fill {fill}: --method {config.method} judges complete plans only, so all actions "
            "begin at once (--fill together)"
        )


def check_seeds(training: Sequence[int]) -> None:
    """Refuses training seeds that are out of range, or one seed twice.

    Raises:
        UserError: says which.
    """
    if not training:
        raise UserError("--seeds needs at least one seed")
    for seed in training:
        seeds.training_seeds(seed)
        if training.count(seed) > 1:
            raise UserError(f"--seeds names {seed} twice: both would be one run")


def check_target_return(config: AnyConfig) -> None:
    """Refuses to ask for a return where the model is not told of any.

    Raises:
        UserError: says which option is missing.
    """
    settings = config.method_settings
    if getattr(settings, "returns", True):
        return
    default = preset(config.domain, config.level, config.method, config.preset).method_settings
    if settings.target_return != default.target_return:
        raise UserError(
            f"--target-return {settings.target_return}: --method {config.method} is told of "
            "returns with --returns only"
        )


def check_memory(config: AnyConfig, domain: Domain) -> None:
    """Refuses what would need more memory than the machine has, by what it needs at least.

    This is arithmetic, which a number of any size passes at once. What is exact follows when the
    programs of a run are compiled: `memory.check_program`.

    Raises:
        UserError: says which options ask for it.
    """
    model, search, training = config.model, config.planner, config.training
    horizon, paper = search.horizon, model.architecture == "paper"
    observation = sum(leaf.nbytes for leaf in jax.tree.leaves(domain.blank))
    context = (observation + 8) * (config.context + 1)
    tokens = 2 * (horizon + config.context) if paper else horizon
    layer = layer_bytes(model, tokens)
    times = domain.max_steps if paper else 0  # each has an embedding
    embeddings = times + tokens + domain.num_actions
    needs = {
        # Parameters, their gradients and Adam's two moments.
        "--width, --layers, --max-steps": 4 * 4 * (
            12 * model.layers * model.width**2 + model.width * embeddings
        ),
        "--episodes, --context": config.episodes * OUTCOME
        + min(config.episodes, MOST_OPEN) * context,
    }  # fmt: skip
    if training.steps and config.checkpoint is None:
        masking = getattr(config.method_settings, "masking", "one")
        copies = horizon if masking in COPYING else 1
        together = min(training.batch, training.microbatch or training.batch)
        activations = together * copies * model.layers * layer
        needs["--batch, --context, --horizon"] = training.batch * context + activations
        source = domain.source
        # A demonstration has two states at least.
        states = 2 * config.demos if source is None else source.amount
        needs["--demos" if source is None else f"--{source.unit}"] = states * observation
    # Plans are made together. Each restart is scored, as are candidates: with T passes.
    many = getattr(search, "beams", getattr(search, "candidates", getattr(search, "restarts", 1)))
    scored = (many > 1 and not hasattr(search, "beams")) or search.score
    passes = many * (horizon if scored else 1)
    plans = min(PLANS_TOGETHER, config.episodes)
    choices = 4 * many * (search.iterations if isinstance(search, GibbsConfig) else 1)
    drawn = getattr(search, "resampled", 1) * domain.num_actions + horizon
    needs["--iterations, --restarts, --beams, --candidates, --horizon"] = plans * (
        passes * layer + choices * drawn
    )
    memory.check(needs)


def layer_bytes(model: ModelConfig, tokens: int) -> int:
    """Bytes that a layer makes of so many tokens, at least."""
    # Queries, keys, values and so on; and the weights of attention.
    return 4 * (12 * model.width * tokens + model.heads * tokens**2)


def make_domain(config: AnyConfig) -> Domain:
    """The level of a configuration: the one that is played."""
    return find_domain(config.domain).make(config.play or config.level, config.domain_settings)


def specify(config: AnyConfig, seed: int, domain: Domain) -> Specification:
    """What a run leaves beside its parameters."""
    return Specification(
        config.domain, config.level, config.method, config.context,
        **{group: getattr(config, group) for group in GROUPS},
        signature=dict(domain.signature),
        origin=Origin(config.preset, seed, config.demos, config.demonstrations),
    )  # fmt: skip


def check_counts(options: object, *names: str) -> None:
    """Refuses options that count something and are not positive, or more than can be counted.

    Raises:
        UserError: says which.
    """
    for name in names:
        check_integer(f"--{name.replace('_', '-')}", getattr(options, name), 1)


def check_executed(executed: int | None, horizon: int, of: str = "") -> None:
    """Refuses to execute more of a plan than there is.

    Raises:
        UserError: says how much there is.
    """
    if executed is not None and not 1 <= executed <= horizon:
        raise UserError(f"--executed {executed} is not in 1 .. {horizon}, the horizon{of}")


def episode_seeds(config: AnyConfig) -> range:
    """The level seeds of the episodes that success is measured on.

    Raises:
        UserError: they leave their range.
    """
    first = seeds.validation_seeds if config.validation else seeds.test_seeds
    return first(config.test_seed, config.episodes)


def resolved(config: AnyConfig, seed: int) -> dict[str, Any]:
    """All settings that one seed's result depends on, as JSON values."""
    values = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_HASHED}
    return json.loads(json.dumps({**values, "seed": seed}))


def configuration_hash(config: AnyConfig, seed: int) -> str:
    """Twelve hexadecimal digits that name a configuration.

    They are those of domain, level, method and what differs from the defaults alone, so that a
    setting that is added later, with what was done before as its default, changes no name. To
    train and to play a checkpoint again are two things.
    """
    names = {"domain": config.domain, "level": config.level, "method": config.method}
    defaults = resolved(blank(config.domain, config.level, config.method), seed=-1)
    values = resolved(config, seed)
    values["training"] = pretrained.without_unnamed(values["training"])
    settings = configurations.differences(values, defaults)
    again = {"evaluation": True} if config.checkpoint is not None else {}
    text = json.dumps({**names, **settings, **again}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
