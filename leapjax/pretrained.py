"""Trained planners on disk: what `leapjax.load` reads and every run writes."""

import dataclasses
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from leapjax import checkpoints, weights
from leapjax.agents.learning import UNNAMED, Setup, TrainingConfig
from leapjax.batching import CHUNK_SIZES, CompiledPlanner, compile_planner
from leapjax.checks import check_at_least, check_types
from leapjax.domain import Domain, Statistics, apply_statistics
from leapjax.domains import check_imported, find_domain
from leapjax.errors import UserError, first_line
from leapjax.files import check_path, write_text
from leapjax.methods import find_method
from leapjax.models.trajectory import ModelConfig
from leapjax.planners import PlannerConfig
from leapjax.types import Agent, Array, Context, Energy, Params, Plan

SPECIFICATION = "specification.json"
LARGEST_SPECIFICATION = 2**20  # bytes
CHECKPOINTS = "checkpoints"
WEIGHTS = "weights.npz"  # in place of checkpoints, in the folder of a published planner
PUBLISHED = Path(__file__).parent / "published"
GROUPS = ("model", "training", "planner", "method_settings", "domain_settings")  # of settings


@dataclasses.dataclass(frozen=True)
class Origin:
    """What a planner was trained on, and by which preset: nothing that rebuilding it needs."""

    preset: str
    seed: int
    demos: int
    demonstrations: str | None = None

    def __post_init__(self) -> None:
        check_types(self)


@dataclasses.dataclass(frozen=True)
class Specification:
    """All that is needed to rebuild a planner around its parameters."""

    domain: str
    level: str
    method: str
    context: int  # K
    model: ModelConfig
    training: TrainingConfig
    planner: PlannerConfig  # its horizon is the network's too
    method_settings: Any
    domain_settings: Any
    signature: dict  # of the domain, when it was trained
    origin: Origin
    statistics: Statistics = ()  # of what it learned from, as far as its network needs them

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 0, "context")


@dataclasses.dataclass(frozen=True)
class Pretrained:
    """A ready planner: `pretrained(keys, contexts)` plans for any number of contexts."""

    specification: Specification
    energy: Energy
    params: Params
    plan: CompiledPlanner

    def __call__(self, keys: Array, contexts: Context) -> Plan:
        """Plans for B contexts (see `leapjax.rollouts.stack_contexts`)."""
        return self.plan(self.params, keys, contexts)


def make_domain(specification: Specification, level: str | None = None) -> Domain:
    """The level that a planner was trained for, or another one for the same network.

    Raises:
        UserError: it cannot be made, or only the specification names it and its module has not
            been imported.
    """
    if level is None:
        level = specification.level
        check_imported(level, f"the specification of a {specification.method} planner")
    kind = find_domain(specification.domain)
    domain = kind.make(level, specification.domain_settings)
    return apply_statistics(domain, specification.statistics)


def make_agent(specification: Specification, domain: Domain, mesh: Mesh | None = None) -> Agent:
    """The agent of a specification; `mesh`: of devices to train on, None for one device.

    Raises:
        UserError: the method cannot be had with these settings.
    """
    setup = Setup(
        domain, specification.context, specification.planner.horizon, specification.model,
        specification.training, specification.method_settings,
    )  # fmt: skip
    return find_method(specification.method).make_agent(setup, mesh)


def identity(specification: Specification) -> str:
    """What checkpoints of a run are sealed with: all of its specification but the defaults."""
    defaults = {name: type(getattr(specification, name))() for name in GROUPS}
    plain = dataclasses.asdict(dataclasses.replace(specification, **defaults))
    values = dataclasses.asdict(specification)
    changed = {name: checkpoints.differences(values[name], plain[name]) for name in GROUPS}
    changed["training"] = without_unnamed(changed["training"])
    if not specification.statistics:  # as before there were any
        del values["statistics"]
    return json.dumps(values | changed, sort_keys=True)


def without_unnamed(training: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of training that a result depends on."""
    return {name: value for name, value in training.items() if name not in UNNAMED}


def save_specification(folder: Path, specification: Specification) -> None:
    """Writes the specification of a run, atomically."""
    write_text(folder / SPECIFICATION, json.dumps(dataclasses.asdict(specification), indent=1))


def read_specification(folder: Path) -> Specification:
    """The specification that a run left in its folder, if its parameters were saved with it.

    Raises:
        UserError: missing, damaged, of an unknown method or domain, or changed since.
    """
    return _read_sealed(folder)[0]


def _read_sealed(folder: Path) -> tuple[Specification, list[int]]:
    """The specification in a folder, and how many numbers each array saved with it has.

    Nothing is built, imported or unpacked before this: a specification is what a file says.
    """
    specification = parse_specification(check_path(folder))
    whose = identity(specification)
    if (folder / WEIGHTS).exists():
        return specification, weights.check_identity(folder / WEIGHTS, whose)
    return specification, checkpoints.check_identity(folder / CHECKPOINTS, whose)


def parse_specification(folder: Path) -> Specification:
    """What the specification in a folder says, whether parameters were saved with it or not.

    Raises:
        UserError: missing, damaged, or of an unknown method or domain.
    """
    path = folder / SPECIFICATION
    if not path.is_file():
        raise UserError(
            f"{folder} is not a checkpoint: expected the folder of a run, with {SPECIFICATION}"
        )
    values = checkpoints.read_json(path, LARGEST_SPECIFICATION)
    try:
        if not isinstance(values, dict):
            raise UserError(f"a Specification must be a JSON object, got {type(values).__name__}")
        method = find_method(str(values.get("method")))
        return checkpoints.from_json(
            Specification, values,
            method_settings=method.settings, planner=method.planner,
            domain_settings=find_domain(str(values.get("domain"))).settings,
        )  # fmt: skip
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def published(name: str) -> Path:
    """The folder of a planner that comes with the library.

    Raises:
        UserError: there is none of this name.
    """
    names = sorted(path.name for path in PUBLISHED.glob("*") if path.is_dir())
    if name not in names:
        raise UserError(f"no planner is published for {name!r}: only for {', '.join(names)}")
    return PUBLISHED / name


def publish(folder: Path, target: Path) -> None:
    """Makes a published planner of a run: its parameters in half precision.

    Raises:
        UserError: the run cannot be read, has not come to its end, or the target not be written.
    """
    planner = load(folder, finished=True)
    weights.write(target / WEIGHTS, planner.params, identity(planner.specification))
    save_specification(target, planner.specification)


def find(path: str | os.PathLike[str]) -> Path:
    """The folder of a run; or, where there is none, of the published planner of a level.

    Raises:
        UserError: the system cannot look for such a path.
    """
    folder = check_path(path)
    published = not folder.exists() and (PUBLISHED / folder).is_dir()
    return PUBLISHED / folder if published else folder


def asking_for(specification: Specification, target_return: float) -> Specification:
    """The same planner, asked for another return.

    Raises:
        UserError: it is not conditioned on returns.
    """
    settings = specification.method_settings
    if not hasattr(settings, "target_return") or not getattr(settings, "returns", True):
        raise UserError(
            f"a return of {target_return} cannot be asked for: this {specification.method} has not "
            "learned what leads to which return"
        )
    try:
        settings = dataclasses.replace(settings, target_return=target_return)
    except ValueError as error:
        raise UserError(str(error)) from None
    return dataclasses.replace(specification, method_settings=settings)


def _trace_parameters(
    agent: Agent, specification: Specification, saved: Sequence[int], folder: Path
) -> Params:
    """The shapes and types of an agent's parameters.

    Args:
        agent: of the specification.
        specification: that says how large its network is.
        saved: how many numbers each array has that is there.
        folder: of both, for the message.

    Raises:
        UserError: the network is larger than what was saved, or than any can be.
    """
    largest = max(saved, default=0)
    model = specification.model
    # Each layer, and each round of an encoder, has arrays of its own; one is as wide as all.
    parts = max(model.layers, getattr(specification.domain_settings, "rounds", 0))
    if saved and (parts > len(saved) or model.width > largest):
        raise UserError(
            f"{folder}: a network of {parts} layers or rounds, of width {model.width}, but only "
            f"{len(saved)} arrays of at most {largest} numbers were saved"
        )
    try:
        return jax.eval_shape(agent.init, jax.random.key(0)).params
    except (ArithmeticError, MemoryError, TypeError, ValueError) as error:
        raise UserError(f"{folder}: its network cannot be built: {first_line(error)}") from error


def load(
    path: str | os.PathLike[str],
    planner: PlannerConfig | None = None,
    chunk_sizes: Sequence[int] = CHUNK_SIZES,
    level: str | None = None,
    target_return: float | None = None,
    finished: bool = False,
) -> Pretrained:
    """A trained planner from the folder of its run, or one that comes with the library.

    Args:
        path: the folder that a run printed; or the name of a level, where there is no such
            folder: the published planner, trained on it with seed 0 (README, "Results").
        planner: search settings, of the same horizon; None for those it was trained with.
        chunk_sizes: see `leapjax.compile_planner`.
        level: to plan for, where it is another than it was trained on, and its network serves both.
            A run on a level `module:id` needs it too, unless that module is imported already.
        target_return: to ask for, where that is another than it was trained for.
        finished: whether nothing will do but what the run has learned at its end. If not, what it
            had learned at its newest readable checkpoint will, with a warning.

    Raises:
        UserError: no such run, one that cannot be read or has not come to its end, another
            horizon, a level that needs another network, or a return that it cannot be asked for.
    """
    if planner is not None and not isinstance(planner, PlannerConfig):
        raise UserError(f"planner must be a configuration such as GibbsConfig, got {planner!r}")
    if not isinstance(level, str | None):
        raise UserError(f"level must be a text, got {level!r}")
    folder = find(path)
    specification, saved = _read_sealed(folder)
    whose = identity(specification)
    if target_return is not None:
        specification = asking_for(specification, target_return)
    horizon = specification.planner.horizon
    if planner is not None and planner.horizon != horizon:
        raise UserError(f"{folder} plans {horizon} actions, not {planner.horizon}: its horizon")
    # First: the module of a level that the caller names is imported by it.
    other = None if level is None else make_domain(specification, level)
    domain = make_domain(specification)
    for name, value in domain.signature.items():
        if specification.signature.get(name) != value:
            raise UserError(f"{folder}: trained with another {name}; train it again")
    if other is not None:
        for name, value in other.signature.items():
            if domain.signature.get(name) != value:
                raise UserError(
                    f"{folder} was trained on {domain.level}, whose {name} is "
                    f"{domain.signature.get(name)}: it cannot play {level}, where it is {value}"
                )
        # A network that counts steps counts no further than it has learned to.
        domain = other._replace(max_steps=domain.max_steps)
    agent = make_agent(specification, domain)
    like = _trace_parameters(agent, specification, saved, folder)
    if (folder / WEIGHTS).exists():
        params = weights.read(folder / WEIGHTS, like, whose)
    else:
        params = checkpoints.restore_params(
            folder / CHECKPOINTS, like, whose, specification.training.steps if finished else None
        )
        step = checkpoints.newest(folder / CHECKPOINTS)[0]
        if step < specification.training.steps:
            warnings.warn(
                f"{folder} ends at step {step} of {specification.training.steps}", stacklevel=2
            )
    specification = dataclasses.replace(
        specification, planner=planner or specification.planner, level=level or specification.level
    )
    plan = compile_planner(
        agent.energy, specification.planner, chunk_sizes, encode_next=agent.encode_next
    )
    return Pretrained(specification, agent.energy, params, plan)
