"""Trained planners on disk: `leapjax.load` reads them, and every run writes its own."""

import dataclasses
import importlib
import json
import os
import types
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from leapjax import domains, rollouts, serialization, weights
from leapjax.agents.base import UNNAMED, Setup, TrainingConfig
from leapjax.agents.returns import aims_for_return
from leapjax.batching import CompiledPlanner, compile_planner, plan_keys
from leapjax.checks import check_at_least, check_seed, check_types
from leapjax.domain import Domain, Statistics, apply_statistics, blank_context, find_signature
from leapjax.domains import check_imported, find_domain
from leapjax.environments import Adapter
from leapjax.errors import UserError, did_you_mean, first_line
from leapjax.extras import report_missing
from leapjax.files import check_path, write_text
from leapjax.methods import find_method
from leapjax.models.config import ModelConfig
from leapjax.planners import PlannerConfig
from leapjax.types import Agent, Array, Context, Energy, Params, Plan

SPECIFICATION = "specification.json"
LARGEST_SPECIFICATION = 2**20  # bytes
CHECKPOINTS = "checkpoints"
WEIGHTS = "weights.npz"  # a published planner has it in place of checkpoints
PUBLISHED = Path(__file__).parent / "published"
GROUPS = ("model", "training", "planner", "method_settings", "domain_settings")  # settings


@dataclasses.dataclass(frozen=True)
class Origin:
    """The data, preset and seed of training. They are not needed to rebuild the planner.

    Attributes:
        preset: name of the preset.
        seed: seed of training.
        demos: number of demonstrations.
        demonstrations: their data set; `None` if the domain made them or they were in memory.
    """

    preset: str
    seed: int
    demos: int
    demonstrations: str | None = None

    def __post_init__(self) -> None:
        check_types(self)


@dataclasses.dataclass(frozen=True)
class Specification:
    """Everything but the parameters that is needed to rebuild a planner.

    Attributes:
        domain: name of the domain in `leapjax.domains`.
        level: level that the planner was trained for.
        method: name of the method in `leapjax.methods`.
        context: K, number of past steps that the network sees.
        model: architecture and size of the network.
        training: settings of training.
        planner: settings of the search; the network has its horizon.
        method_settings: options that only this method has.
        domain_settings: options of encoders, augmentations and environment.
        signature: signature of the domain at the time of training.
        origin: data, preset and seed of training.
        statistics: statistics of the training data that the network needs; `()` if it needs no
            statistics.
    """

    domain: str
    level: str
    method: str
    context: int
    model: ModelConfig
    training: TrainingConfig
    planner: PlannerConfig
    method_settings: Any
    domain_settings: Any
    signature: dict
    origin: Origin
    statistics: Statistics = ()

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 0, "context")


@dataclasses.dataclass(frozen=True, repr=False)
class Pretrained:
    """A ready planner: `pretrained(keys, contexts)` plans for any number of contexts.

    Attributes:
        specification: everything but the parameters that is needed to rebuild it.
        energy: energy that it minimises.
        params: parameters of the energy.
        plan: the compiled planner: `(params, keys, contexts) -> Plan`.
        domain: level that it plays; `domain.make_adapter()` makes an environment.
        step: training step of the parameters; `None` if training has ended.
    """

    specification: Specification
    energy: Energy
    params: Params
    plan: CompiledPlanner
    domain: Domain
    step: int | None = None

    def __call__(self, keys: Array, contexts: Context) -> Plan:
        """Plans for B contexts (see `leapjax.rollouts.stack_contexts`)."""
        return self.plan(self.params, keys, contexts)

    def plan_for(self, adapter: Adapter, seed: int = 0) -> Plan:
        """Resets an environment and makes one plan for its first state.

        `leapjax.evaluate`, with its default seed, begins the episode of this level seed with the
        same plan.

        Args:
            adapter: an environment, such as `domain.make_adapter()` makes.
            seed: level seed, in 0 .. 2^32 - 1.

        Returns:
            A `Plan` of NumPy arrays, without a leading `[B]`: `actions` is `[T]`.

        Raises:
            UserError: `adapter` is not an adapter, or the network does not fit its observations.
            ValueError: the environment and the planner have different actions.
        """
        seed = check_seed(seed)
        rollouts.check_adapter(adapter)
        rollouts.check_actions("planner", self.plan.num_actions, adapter.num_actions)
        history = rollouts.History(
            adapter.reset(seed), self.specification.context, adapter.num_actions, seed
        )
        keys = plan_keys(0, np.array([seed]), np.array([0]))
        plans = self(keys, rollouts.stack_contexts([history]))
        return jax.tree.map(lambda leaf: leaf[0], plans)

    def compile(self, batch: int = 1, executed: int | None = None) -> None:
        """Compiles the programs for up to `batch` plans, so that later calls start at once.

        Args:
            batch: B, the largest number of contexts in a call.
            executed: number of actions that `leapjax.evaluate` executes of each plan; `None` for
                all. If it is 1, plans after the first use a cache.

        Raises:
            UserError: `batch` or `executed` is not a positive integer.
        """
        context = blank_context(self.domain, self.specification.context)
        executed, _ = rollouts.check_limits(executed, None)
        again = 1 in (executed, self.specification.planner.horizon)
        self.plan.compile(self.params, context, batch, again)

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Writes a folder that `leapjax.load` reads: a specification, and the parameters.

        Args:
            folder: new folder.

        Raises:
            UserError: the folder exists or cannot be written; or `leapjax.make_domain` did not make
                the domain, so no file could say how to rebuild the network.
        """
        if not self.specification.domain:
            raise UserError(
                f"a planner of {self.domain.level} cannot be saved: its domain is not made by "
                "leap.make_domain; keep planner.params, and fit with the same domain and steps=0"
            )
        checkpoints = _import_checkpoints()
        folder, specification = check_path(folder), self.specification
        if folder.exists():
            raise UserError(f"{folder} is there already: name a new folder")
        checkpoints.save_params(
            folder / CHECKPOINTS,
            self.params,
            describe_identity(specification),
            specification.training.steps if self.step is None else self.step,
        )
        save_specification(folder, specification)

    def __repr__(self) -> str:
        known = self.specification
        model, origin, leaves = known.model, known.origin, jax.tree.leaves(self.params)
        data = f"{origin.demos} demonstrations"
        data += f" of {origin.demonstrations}" if origin.demonstrations else ""
        return "\n".join([
            f"Pretrained: {known.method} on {self.domain.level}, trained on {data}, preset "
            f"{origin.preset}, seed {origin.seed}",
            f"  network: {model.architecture}, {model.layers} layers of width {model.width}, "
            f"{sum(leaf.size for leaf in leaves):,} parameters",
            f"  planner: {known.planner}",
        ])  # fmt: skip


def make_domain(specification: Specification, level: str | None = None) -> Domain:
    """Makes the level that a planner was trained for, or another level for the same network.

    Raises:
        UserError: the level cannot be made; or only the specification names it, and its module has
            not been imported.
    """
    if level is None:
        level = specification.level
        check_imported(level, f"the specification of a {specification.method} planner")
    domain = domains.make_level(specification.domain, level, specification.domain_settings)
    return apply_statistics(domain, specification.statistics)


def make_agent(specification: Specification, domain: Domain, mesh: Mesh | None = None) -> Agent:
    """Makes the agent of a specification.

    Args:
        specification: of the agent.
        domain: level to train on, such as `make_domain` makes.
        mesh: devices to train on; `None` for one device.

    Raises:
        UserError: the method does not support these settings.
    """
    setup = Setup(
        domain, specification.context, specification.planner.horizon, specification.model,
        specification.training, specification.method_settings,
    )  # fmt: skip
    return find_method(specification.method).make_agent(setup, mesh)


def describe_identity(specification: Specification) -> str:
    """Describes a run as JSON, to seal its checkpoints; leaves out settings with their default.

    Raises:
        UserError: a setting is a function, which no file can hold.
    """
    defaults = {name: type(getattr(specification, name))() for name in GROUPS}
    plain = dataclasses.asdict(dataclasses.replace(specification, **defaults))
    values = dataclasses.asdict(specification)
    changed = {name: serialization.find_differences(values[name], plain[name]) for name in GROUPS}
    changed["training"] = drop_unnamed(changed["training"])
    if not specification.statistics:  # so that older checkpoints keep their seal
        del values["statistics"]
    return json.dumps(values | changed, sort_keys=True, default=_refuse_function)


def _refuse_function(value: Any) -> Any:
    raise UserError(
        f"{value} cannot be saved: a file holds names and numbers; give the planner a strategy by "
        "name, such as fill='confident', and your own when you plan (compile_planner)"
    )


def drop_unnamed(training: Mapping[str, Any]) -> dict[str, Any]:
    """Drops the settings of training that do not change a result."""
    return {name: value for name, value in training.items() if name not in UNNAMED}


def save_specification(folder: Path, specification: Specification) -> None:
    """Writes the specification of a run, atomically."""
    write_text(folder / SPECIFICATION, json.dumps(dataclasses.asdict(specification), indent=1))


def read_specification(folder: Path) -> Specification:
    """Reads the specification of a run, and checks that the saved parameters belong to it.

    Raises:
        UserError: the file is missing, damaged or changed since, or has an unknown method or
            domain.
    """
    return _read_sealed(folder)[0]


def _read_sealed(folder: Path) -> tuple[Specification, list[int]]:
    """Reads and checks a specification; also returns the size of each saved array.

    Call this before you build the network, import the level's module or unpack the arrays: the
    specification is an input, which may be wrong.
    """
    specification = parse_specification(check_path(folder))
    whose = describe_identity(specification)
    if (folder / WEIGHTS).exists():
        return specification, weights.check_identity(folder / WEIGHTS, whose)
    return specification, _import_checkpoints().check_identity(folder / CHECKPOINTS, whose)


def _import_checkpoints() -> types.ModuleType:
    """Imports Orbax late: the import is slow, and published planners do not need it.

    Raises:
        UserError: Orbax is not installed.
    """
    with report_missing():
        return importlib.import_module("leapjax.checkpoints")


def parse_specification(folder: Path) -> Specification:
    """Reads the specification in a folder, without looking for saved parameters.

    Raises:
        UserError: the file is missing or damaged, or has an unknown method or domain.
    """
    path = folder / SPECIFICATION
    if not path.is_file():
        raise UserError(
            f"{folder} is not a checkpoint: expected the folder of a run, with {SPECIFICATION}"
        )
    values = serialization.read_json(path, LARGEST_SPECIFICATION)
    try:
        if not isinstance(values, dict):
            raise UserError(f"a Specification must be a JSON object, got {type(values).__name__}")
        method = find_method(str(values.get("method")))
        return serialization.from_json(
            Specification, values,
            method_settings=method.settings, planner=method.planner,
            domain_settings=find_domain(str(values.get("domain"))).settings,
        )  # fmt: skip
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def find_published(name: str) -> Path:
    """Finds the folder of a planner that comes with the library.

    Of a family of levels, a planner plays every level: `BabyAI` plays `BabyAI-GoTo-v0`.

    Raises:
        UserError: no published planner plays this level.
    """
    names = sorted(path.name for path in PUBLISHED.glob("*") if path.is_dir())
    for known in (name, name.partition("-")[0]):
        if known in names:
            return PUBLISHED / known
    hint = did_you_mean(name, names)
    raise UserError(f"no planner is published for {name!r}: only for {', '.join(names)}{hint}")


def publish(folder: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """Writes a trained planner as two small files, its parameters in half precision.

    The files are `specification.json` and `weights.npz`. `load` reads their folder from any place.

    Args:
        folder: folder of a run, or of `Pretrained.save`.
        target: folder to write to.

    Raises:
        UserError: the run cannot be read or is not finished, or the target cannot be written.
    """
    planner, target = load(folder, finished=True), check_path(target)
    weights.write(target / WEIGHTS, planner.params, describe_identity(planner.specification))
    save_specification(target, planner.specification)


def find_folder(path: str | os.PathLike[str]) -> Path:
    """Finds the folder of a run or, if it does not exist, of a level's published planner.

    Raises:
        UserError: the system cannot look up the path; or there is neither.
    """
    folder = check_path(path)
    if folder.exists():
        return folder
    try:
        return find_published(str(path))
    except UserError as error:
        raise UserError(f"there is no folder {folder}, and {error}") from None


def ask_for_return(specification: Specification, target_return: float) -> Specification:
    """Returns the specification with another return to aim at.

    Raises:
        UserError: the planner is not conditioned on returns, or does not accept this return.
    """
    settings = specification.method_settings
    if not aims_for_return(settings):
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
    """Finds the shapes and types of an agent's parameters, without computing them.

    Args:
        agent: made from the specification.
        specification: gives the size of the network.
        saved: number of elements of each saved array.
        folder: folder of the planner, for the message.

    Raises:
        UserError: the network is larger than the saved arrays, or too large to build.
    """
    largest = max(saved, default=0)
    model = specification.model
    # Each layer and each round of an encoder has its own arrays. At least one array of the network
    # has as many numbers as the network is wide.
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
    chunk_sizes: Sequence[int] | None = None,
    level: str | None = None,
    target_return: float | None = None,
    finished: bool = False,
) -> Pretrained:
    """Loads a trained planner from the folder of its run, or a planner of the library.

    Compiled programs are kept on disk (see `leapjax.compile_planner`), so the first plan of a
    second process takes little more than its imports.

    Args:
        path: folder that a run printed. If it does not exist: the name of a level, for the
            published planner of this level, or of its family (see `find_published`).
        planner: search settings with the same horizon; `None` for the settings of the run.
        chunk_sizes: see `leapjax.compile_planner`.
        level: level to plan for; `None` for the level of training. The network must fit both. If
            the run's level is `module:id` and the module is not imported yet, give the level again.
        target_return: return to aim at; `None` for the target of the run.
        finished: whether the run must be finished. If not, the newest readable checkpoint is
            loaded, with a warning if training had not ended.

    Raises:
        UserError: the run does not exist, cannot be read or is not finished. `planner` has another
            horizon, `level` needs another network, or the planner cannot aim at `target_return`.
    """
    if planner is not None and not isinstance(planner, PlannerConfig):
        raise UserError(f"planner must be a configuration such as GibbsConfig, got {planner!r}")
    if not isinstance(level, str | None):
        raise UserError(f"level must be a text, got {level!r}")
    folder = find_folder(path)
    if level is None and folder != check_path(path):
        level = str(path)  # the name of a published planner's level
    specification, saved = _read_sealed(folder)
    whose = describe_identity(specification)
    if target_return is not None:
        specification = ask_for_return(specification, target_return)
    horizon = specification.planner.horizon
    if planner is not None and planner.horizon != horizon:
        raise UserError(f"{folder} plans {horizon} actions, not {planner.horizon}: its horizon")
    # This comes first, because it imports the module of the level that the caller names.
    other = None if level is None else make_domain(specification, level)
    domain = make_domain(specification)
    signature = find_signature(domain, specification.model.architecture)
    for name, value in signature.items():
        if specification.signature.get(name) != value:
            raise UserError(f"{folder}: trained with another {name}; train it again")
    if other is not None:
        needed = find_signature(other, specification.model.architecture)
        for name, value in needed.items():
            if signature.get(name) != value:
                raise UserError(
                    f"{folder} was trained on {domain.level}, whose {name} is "
                    f"{signature.get(name)}: it cannot play {level}, where it is {value}"
                )
        # A network that embeds step numbers has embeddings up to the limit of its training level.
        domain = other._replace(max_steps=domain.max_steps)
    agent = make_agent(specification, domain)
    like = _trace_parameters(agent, specification, saved, folder)
    step = None
    if (folder / WEIGHTS).exists():
        params = weights.read(folder / WEIGHTS, like, whose)
    else:
        checkpoints = _import_checkpoints()
        params, step = checkpoints.restore_params(
            folder / CHECKPOINTS, like, whose, specification.training.steps if finished else None
        )
        if step < specification.training.steps:
            warnings.warn(
                f"{folder} ends at step {step} of {specification.training.steps}", stacklevel=2
            )
    specification = dataclasses.replace(specification, planner=planner or specification.planner)
    plan = compile_planner(
        agent.energy, specification.planner, chunk_sizes, encode_next=agent.encode_next
    )
    return Pretrained(specification, agent.energy, params, plan, domain, step)
