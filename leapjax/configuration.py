"""The configuration of a run, and the hash that names it."""

import dataclasses
import hashlib
import json
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro

from leapjax import files, pretrained, serialization
from leapjax.agents.base import TrainingConfig
from leapjax.data import seeds
from leapjax.data.seeds import UNSEEN
from leapjax.domain import Domain, drop_files, find_signature
from leapjax.domains import find_domain, make_level
from leapjax.methods import find_method
from leapjax.models.config import ModelConfig
from leapjax.pretrained import GROUPS, Origin, Specification
from leapjax.processes import Cluster

M = TypeVar("M")
D = TypeVar("D")
P = TypeVar("P")


# A program with other names of options has a subclass, which annotates the renamed fields.
@dataclasses.dataclass(frozen=True)
class Config(Generic[M, D, P]):
    """Train a method on demonstrations of a level, then measure its success.

    Attributes:
        level: Name or id of a level, or "all" for the paper's levels.
        method: One or more methods: leap, classifier, bc, dt, bcq, iql, mopo, plate, cql, qr_dqn,
            rem, rules, random; or "all" for the methods that fit every level.
        preset: Defaults of all other options: "leapjax" for ours, "paper" for the paper's.
        seeds: Training seeds; each draws its own demonstrations.
        demos: Demonstrations to train on; at most as many as a given data set has.
        demonstrations: Id of a Minari data set to train on, instead of demonstrations made for the
            level. If the data set names a level, that level is the default.
        episodes: Held-out episodes to measure success on.
        test_seed: Level seed of the first of these episodes.
        validation: Measure success on validation levels instead, to choose settings.
        context: K, past steps that the planner sees.
        executed: Actions to execute before replanning; `None` for the whole plan, as in the paper.
        rules: Weight of the level's own rules in the energy while planning; 0 leaves them out.
        checkpoint: Folder of an earlier run to evaluate instead of training. Its settings become
            the defaults, except `--executed` and `--rules`.
        play: Level to play instead of the level that the checkpoint's planner was trained on.
        pretrained: Evaluate the planner that comes with the library for the level, instead of
            training.
        record: Append the row to results/, which is committed; skip a run that is already there.
        force: With `--record`: repeat a recorded run and replace its row.
        runs: Folder for checkpoints, metrics, plots and unrecorded rows.
        pictures: Draw the plots and the animation.
        loggers: Where measurements also go: "tensorboard", "wandb" (offline, unless WANDB_MODE says
            otherwise).
        checkpoint_seconds: Seconds between checkpoints: the most work that a killed run can lose. A
            run of several processes can lose up to 20 steps more.
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
        """Returns the name of a field on the command line, such as "--level"."""
        hint = typing.get_type_hints(cls, include_extras=True)[field]
        names = [getattr(each, "name", None) for each in getattr(hint, "__metadata__", ())]
        return f"--{next(filter(None, names), field.replace('_', '-'))}"


AnyConfig = Config[Any, Any, Any]  # of any method, domain and planner

# Fields on which a result does not depend, or which its row holds separately.
_NOT_HASHED = (
    "seeds", "checkpoint", "pretrained", "record", "force", "runs", "pictures",
    "checkpoint_seconds", "cluster", "loggers",
)  # fmt: skip


def make_config(domain: str, level: str, method: str) -> AnyConfig:
    """Returns the default of every option, without any preset.

    Raises:
        UserError: the domain or the method is unknown.
    """
    chosen = find_method(method)
    settings = chosen.settings(), find_domain(domain).settings(), chosen.planner()
    return Config(*settings, domain, level, method)


def change(config: AnyConfig, **changes: Any) -> AnyConfig:
    """Returns a copy of a configuration with some fields changed.

    Args:
        config: configuration to copy.
        changes: new values by field. A dictionary changes fields inside a part, as in
            `change(config, executed=3, planner={"temperature": 1.0})`.
    """
    found = {
        name: dataclasses.replace(getattr(config, name), **value)
        if isinstance(value, Mapping)
        else value
        for name, value in changes.items()
    }
    return dataclasses.replace(config, **found)


def list_settings(config: AnyConfig, seed: int) -> dict[str, Any]:
    """Returns all settings that the result of a training seed depends on, as JSON values.

    A path stands for the name and the contents of its file.
    """
    values = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_HASHED}
    return json.loads(json.dumps({**values, "seed": seed}, default=files.describe))


def hash_config(config: AnyConfig, seed: int) -> str:
    """Returns twelve hexadecimal digits that name a configuration and a seed.

    The hash covers the domain, the level, the method, and every setting that differs from its
    default. So a new setting whose default keeps the old behaviour changes no hash. A run that
    trains and a run that evaluates a checkpoint have different hashes.
    """
    names = {"domain": config.domain, "level": config.level, "method": config.method}
    defaults = list_settings(make_config(**names), seed=-1)
    values = list_settings(config, seed)
    values["training"] = pretrained.drop_unnamed(values["training"])
    settings = serialization.find_differences(values, defaults)
    again = {"evaluation": True} if config.checkpoint is not None else {}
    text = json.dumps({**names, **settings, **again}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def make_domain(config: AnyConfig) -> Domain:
    """Makes the level that a configuration plays."""
    return make_level(config.domain, config.play or config.level, config.domain_settings)


def specify(config: AnyConfig, seed: int, domain: Domain) -> Specification:
    """Makes the specification that a run saves beside its parameters."""
    groups = {group: getattr(config, group) for group in GROUPS}
    groups["domain_settings"] = drop_files(config.domain_settings)
    return Specification(
        config.domain, config.level, config.method, config.context, **groups,
        signature=find_signature(domain, config.model.architecture),
        origin=Origin(config.preset, seed, config.demos, config.demonstrations),
    )  # fmt: skip


def choose_episode_seeds(config: AnyConfig) -> range:
    """Returns the level seeds of the episodes that measure success.

    Raises:
        UserError: the seeds leave the range of test or validation seeds.
    """
    first = seeds.validation_seeds if config.validation else seeds.test_seeds
    return first(config.test_seed, config.episodes)
