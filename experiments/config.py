"""The configuration of an experiment: presets, the command line, the hash that names it."""

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.runtime import Cluster
from leapjax import checkpoints, pretrained
from leapjax.agents.leap import TrainingConfig
from leapjax.data import seeds
from leapjax.envs import levels
from leapjax.envs.levels import Level
from leapjax.envs.vocabulary import LONGEST_CLAUSE
from leapjax.errors import UserError
from leapjax.models.trajectory import ModelConfig
from leapjax.planners import GibbsConfig

PRESETS = ("leapjax", "paper")
CONFIGURATION = "config.json"  # in the folder of a run: all its settings


@dataclasses.dataclass(frozen=True)
class Config:
    """Train a planner on a BabyAI level from demonstrations, then measure its success."""

    level: str = "GoToLocalS7N5"
    """One of the paper's seven levels, any registered BabyAI id, or "all" for the seven."""
    preset: str = "leapjax"
    """"leapjax": ours; "paper": the paper's appendix. Sets the defaults of all the rest."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds; each draws its own demonstrations."""
    demos: int = 500
    """Demonstrations to train on."""
    demonstrations: str | None = None
    """Id of a Minari data set to train on instead of the bot's demonstrations."""
    episodes: int = 200
    """Held-out episodes to measure success on."""
    test_seed: int = 0
    """Level seed of the first of them."""
    validation: bool = False
    """Measure on validation levels instead: for choosing settings."""
    context: int = 0
    """K, past steps that the planner sees."""
    executed: int | None = None
    """Actions to execute before replanning; None: the whole plan, as in the paper."""
    checkpoint: Path | None = None
    """Folder of an earlier run to evaluate instead of training; sets the other defaults."""
    record: bool = False
    """Append the row to results/, which is committed, and skip what is recorded already."""
    force: bool = False
    """With --record: run again what is recorded, and replace its row."""
    runs: Path = Path("runs")
    """Where checkpoints, metrics, plots and unrecorded rows go."""
    pictures: bool = True
    """Draw the plots and the animation."""
    checkpoint_seconds: float = 30.0
    """Save the training state this often: what a killed run can lose at most."""
    model: Annotated[ModelConfig, tyro.conf.arg(name="")] = ModelConfig()
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = TrainingConfig()
    planner: Annotated[GibbsConfig, tyro.conf.arg(name="")] = GibbsConfig()
    cluster: Annotated[Cluster, tyro.conf.arg(name="")] = Cluster()


@dataclasses.dataclass(frozen=True)
class Origin:
    """What a trained model was trained on: its level, and where the demonstrations came from."""

    level: str
    seed: int
    demos: int
    demonstrations: str | None


def read_origin(run: Path) -> Origin:
    """What the folder of a run says of its training.

    Raises:
        UserError: there are no settings in it, or damaged ones.
    """
    path = run / CONFIGURATION
    values = checkpoints.read_json(path)
    if isinstance(values, dict):  # of all the settings only these
        values = {field.name: values.get(field.name) for field in dataclasses.fields(Origin)}
    try:
        return checkpoints.from_json(Origin, values)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


# What a result does not depend on, or what its row holds on its own.
_NOT_HASHED = (
    "seeds", "checkpoint", "record", "force", "runs", "pictures", "checkpoint_seconds", "cluster",
)  # fmt: skip


def preset(level: Level, name: str) -> Config:
    """The defaults of a preset for a level.

    Raises:
        UserError: an unknown preset.
    """
    planner = GibbsConfig(level.horizon, level.iterations)
    if name == "paper":
        model = ModelConfig("paper", dropout=0.1)
        training = TrainingConfig(masking="one", windows="episode")
    elif name == "leapjax":
        # Chosen on validation levels (docs/performance.md): a little noise leads out of plans
        # that lead nowhere, and more iterations than positions give nothing.
        # Where much must be done in one episode, more noise leads out of more of them.
        sequence = level.words > LONGEST_CLAUSE
        planner = dataclasses.replace(
            planner, iterations=level.horizon, temperature=1.0 if sequence else 0.5
        )
        model = ModelConfig(
            "leapjax", dropout=0.0, sweeps=_sweeps(level), word_heads=4 if sequence else 0
        )
        training = TrainingConfig(
            steps=3000 if level.rows * level.columns == 1 else 4000,
            learning_rate=1.5e-3,
            masking="random",
            windows="step",
            augment=True,
            # Known for the paper's levels only: keys open no doors, and an instruction names
            # kind and colour, so that it cannot mean clutter.
            exchange_objects=bool(level.task),
            clutter=0.4 if level.task else 0.0,
        )
    else:
        raise UserError(f"unknown preset {name!r}: expected one of {', '.join(PRESETS)}")
    return Config(
        level.name, name, context=level.context, model=model, training=training, planner=planner
    )


def _sweeps(level: Level) -> int:
    """As many rounds of value iteration as a long way through the level has cells."""
    if not level.task:
        return 48
    rooms = max(level.rows, level.columns)
    side = rooms * (level.room_size - 1) + 1
    return (2 if rooms == 1 else 4) * side  # ways wind from room to room


def parse(arguments: Sequence[str]) -> list[Config]:
    """One configuration per level from a command line; exits with 2 and a reason if it is bad.

    Raises:
        UserError: an unknown level or preset.
    """
    # Level and preset come first: they decide the defaults of all the rest, and of --help.
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("--level", "--preset", "--checkpoint"):
        first.add_argument(name)
    chosen, _ = first.parse_known_args(list(arguments))
    trained = None
    if chosen.checkpoint is not None:
        trained = pretrained.read_specification(Path(chosen.checkpoint))
    level = chosen.level or (trained.level if trained else Config.level)
    name = chosen.preset or (trained.model.architecture if trained else Config.preset)
    configs = []
    for each in list(levels.LEVELS) if level == "all" else [level]:
        default = preset(levels.find_level(each), name)
        if trained:
            origin = read_origin(Path(chosen.checkpoint))
            default = dataclasses.replace(
                default,
                model=trained.model,
                training=trained.training,
                planner=trained.planner,
                context=trained.sizes.context,
                seeds=(origin.seed,),
                demos=origin.demos,
                demonstrations=origin.demonstrations,
            )
        config = dataclasses.replace(_parse(arguments, default), level=each)
        check(config)
        configs.append(config)
    return configs


def _parse(arguments: Sequence[str], default: Config) -> Config:
    try:
        return tyro.cli(Config, args=list(arguments), default=default)
    except ValueError as error:  # the dataclasses refuse values that cannot be
        raise UserError(str(error)) from None


def check(config: Config) -> None:
    """Refuses what cannot work before any long work starts.

    Raises:
        UserError: says what.
    """
    level = levels.find_level(config.level)
    check_counts(config, "demos", "episodes")
    if not config.seeds:
        raise UserError("--seeds needs at least one seed")
    for seed in config.seeds:
        seeds.training_seeds(seed)
    episode_seeds(config)
    if config.demos > seeds.TRAINING_STRIDE:
        raise UserError(f"--demos {config.demos}: at most {seeds.TRAINING_STRIDE} are possible")
    if not config.checkpoint_seconds >= 0:
        raise UserError(f"--checkpoint-seconds must be at least 0, got {config.checkpoint_seconds}")
    if config.context < 0:
        raise UserError(f"--context must be at least 0, got {config.context}")
    check_executed(config.executed, config.planner.horizon)
    limit = shortest_limit(level)
    if config.planner.horizon > limit:
        raise UserError(
            f"--horizon {config.planner.horizon} is longer than an episode of {level.name} "
            f"may last: its step limit is {limit}"
        )


def check_counts(options: object, *names: str) -> None:
    """Refuses options that count something and are not positive.

    Raises:
        UserError: says which.
    """
    for name in names:
        if getattr(options, name) < 1:
            raise UserError(f"--{name} must be at least 1, got {getattr(options, name)}")


def check_executed(executed: int | None, horizon: int, of: str = "") -> None:
    """Refuses to execute more of a plan than there is.

    Raises:
        UserError: says how much there is.
    """
    if executed is not None and not 1 <= executed <= horizon:
        raise UserError(f"--executed {executed} is not in 1 .. {horizon}, the horizon{of}")


def episode_seeds(config: Config) -> range:
    """The level seeds of the episodes that success is measured on.

    Raises:
        UserError: they leave their range.
    """
    first = seeds.validation_seeds if config.validation else seeds.test_seeds
    return first(config.test_seed, config.episodes)


def shortest_limit(level: Level) -> int:
    """The step limit of the level's simplest instruction."""
    env = levels.make_environment(level)
    return env.max_steps or env.room_size**2 * env.num_rows * env.num_cols


def resolved(config: Config, seed: int) -> dict[str, Any]:
    """All settings that one seed's result depends on, as JSON values."""
    values = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_HASHED}
    return json.loads(json.dumps({**values, "seed": seed}))


def configuration_hash(config: Config, seed: int) -> str:
    """Twelve hexadecimal digits that name a resolved configuration."""
    text = json.dumps(resolved(config, seed), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
