"""The configuration of a run, and the hash that names it."""

import dataclasses
import hashlib
import json
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro

from leapjax import pretrained, serialization
from leapjax.agents.base import TrainingConfig
from leapjax.data import seeds
from leapjax.data.seeds import UNSEEN
from leapjax.domain import Domain
from leapjax.domains import find_domain, make_level
from leapjax.methods import find_method
from leapjax.models.config import ModelConfig
from leapjax.pretrained import GROUPS, Origin, Specification
from leapjax.processes import Cluster

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
        return f"--{next(filter(None, names), field.replace('_', '-'))}"


AnyConfig = Config[Any, Any, Any]  # of whatever method, domain and planner

# What a result does not depend on, or what its row holds on its own.
_NOT_HASHED = (
    "seeds", "checkpoint", "pretrained", "record", "force", "runs", "pictures",
    "checkpoint_seconds", "cluster", "loggers",
)  # fmt: skip


def make_config(domain: str, level: str, method: str) -> AnyConfig:
    """The defaults of every option, before any preset.

    Raises:
        UserError: an unknown domain or method.
    """
    chosen = find_method(method)
    settings = chosen.settings(), find_domain(domain).settings(), chosen.planner()
    return Config(*settings, domain, level, method)


def change(config: AnyConfig, **changes: Any) -> AnyConfig:
    """Returns a configuration with fields changed, also those of its parts.

    Args:
        config: to change.
        changes: by field; of a part the fields of its own that change, by name, as in
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
    """All settings that one seed's result depends on, as JSON values."""
    values = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_HASHED}
    return json.loads(json.dumps({**values, "seed": seed}))


def hash_config(config: AnyConfig, seed: int) -> str:
    """Twelve hexadecimal digits that name a configuration.

    They are those of domain, level, method and what differs from the defaults alone, so that a
    setting that is added later, with what was done before as its default, changes no name. To
    train and to play a checkpoint again are two things.
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
    """The level of a configuration: the one that is played."""
    return make_level(config.domain, config.play or config.level, config.domain_settings)


def specify(config: AnyConfig, seed: int, domain: Domain) -> Specification:
    """What a run leaves beside its parameters."""
    return Specification(
        config.domain, config.level, config.method, config.context,
        **{group: getattr(config, group) for group in GROUPS},
        signature=dict(domain.signature),
        origin=Origin(config.preset, seed, config.demos, config.demonstrations),
    )  # fmt: skip


def choose_episode_seeds(config: AnyConfig) -> range:
    """The level seeds of the episodes that success is measured on.

    Raises:
        UserError: they leave their range.
    """
    first = seeds.validation_seeds if config.validation else seeds.test_seeds
    return first(config.test_seed, config.episodes)
