"""The configuration of a run, and the hash that names it."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro

from leapjax import checkpoints, pretrained
from leapjax.agents.learning import TrainingConfig
from leapjax.data.seeds import UNSEEN
from leapjax.domains import find_domain
from leapjax.methods import find_method
from leapjax.models.trajectory import ModelConfig
from leapjax.processes import Cluster

M = TypeVar("M")
D = TypeVar("D")
P = TypeVar("P")


@dataclasses.dataclass(frozen=True)
class Config(Generic[M, D, P]):
    """Train a method on demonstrations of a level, then measure its success."""

    method_settings: Annotated[M, tyro.conf.arg(name="")]
    domain_settings: Annotated[D, tyro.conf.arg(name="")]
    planner: Annotated[P, tyro.conf.arg(name="")]
    domain: Annotated[str, tyro.conf.Suppress]
    level: str
    """A level of the domain by its name or id, or "all" for those of the paper. --game means the
    same to experiments.atari, and --env to experiments.gymnasium."""
    method: str = "leap"
    """How to learn and to act: a line of the table in leapjax/methods.py, or "all" of them."""
    preset: str = "leapjax"
    """"leapjax": ours; "paper": the paper's. Sets the defaults of all the rest."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds; each draws its own demonstrations."""
    demos: int = 500
    """Demonstrations to train on; of a data set that is given, all that it has if it has fewer."""
    demonstrations: str | None = None
    """Id of a Minari data set to train on instead of those that the domain makes; --level follows
    from it where it says of what it is."""
    episodes: int = 200
    """Held-out episodes to measure success on."""
    test_seed: int = UNSEEN
    """Level seed of the first of them."""
    validation: bool = False
    """Measure on validation levels instead: for choosing settings."""
    context: int = 0
    """K, past steps that the planner sees."""
    executed: int | None = None
    """Actions to execute before replanning; None: the whole plan, as in the paper."""
    rules: float = 0.0
    """Weight of the domain's rules, which are added to what was learned while planning."""
    checkpoint: Path | None = None
    """Folder of an earlier run to evaluate instead of training; brings its settings along, but
    --executed and --rules."""
    play: str | None = None
    """Another level to play with a checkpoint than the one that it was trained on."""
    pretrained: bool = False
    """Evaluate the planner that comes with the library for each level; trains nothing."""
    record: bool = False
    """Append the row to results/, which is committed, and skip what is recorded already."""
    force: bool = False
    """With --record: run again what is recorded, and replace its row."""
    runs: Path = Path("runs")
    """Where checkpoints, metrics, plots and unrecorded rows go."""
    pictures: bool = True
    """Draw the plots and the animation."""
    loggers: tuple[str, ...] = ()
    """Where measurements also go: "tensorboard", "wandb" (offline, unless WANDB_MODE says more)."""
    checkpoint_seconds: float = 30.0
    """Save the training state this often: what a killed run can lose at most (of several
    processes: and up to 20 steps more)."""
    model: Annotated[ModelConfig, tyro.conf.arg(name="")] = ModelConfig()
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = TrainingConfig()
    cluster: Annotated[Cluster, tyro.conf.arg(name="")] = Cluster()


AnyConfig = Config[Any, Any, Any]  # of whatever method, domain and planner

# What a result does not depend on, or what its row holds on its own.
_NOT_HASHED = (
    "seeds", "checkpoint", "pretrained", "record", "force", "runs", "pictures",
    "checkpoint_seconds", "cluster", "loggers",
)  # fmt: skip


def blank(domain: str, level: str, method: str) -> AnyConfig:
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
    defaults = resolved(blank(**names), seed=-1)
    values = resolved(config, seed)
    values["training"] = pretrained.without_unnamed(values["training"])
    settings = checkpoints.differences(values, defaults)
    again = {"evaluation": True} if config.checkpoint is not None else {}
    text = json.dumps({**names, **settings, **again}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
