"""Training in one call: from demonstrations to a ready planner."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from leapjax import compilation, pretrained, sharding
from leapjax.agents.base import TrainingConfig
from leapjax.agents.batches import join_demonstrations
from leapjax.agents.measured import measure_settings
from leapjax.agents.value_range import judge_values
from leapjax.batching import compile_planner
from leapjax.checks import check_integer, check_kind
from leapjax.data import storage, windows
from leapjax.domain import (
    Domain,
    apply_statistics,
    find_signature,
    measure_statistics,
)
from leapjax.domains import make_level
from leapjax.errors import UserError
from leapjax.methods import find_method, learns_from_rewards
from leapjax.models.config import ModelConfig
from leapjax.planners import PlannerConfig
from leapjax.presets import find_preset
from leapjax.pretrained import Origin, Pretrained, Specification
from leapjax.training import make_begin, make_train_step, train
from leapjax.types import Demonstration, TrainState

PRESET = "leapjax"
ANY = "gymnasium"  # its presets serve levels of unregistered domains


def report_nothing(step: int, means: dict[str, float]) -> None:
    """Reports nothing."""
    del step, means


def make_domain(name: str, level: str, settings: Any = None) -> Domain:
    """Makes one level of a domain, for `leapjax.fit` and `leapjax.evaluate`.

    Args:
        name: name of the domain: "babyai", "gymnasium", "atari", "stars", "sudoku",
            "countdown" or "satisfiability".
        level: name of the level, such as "GoToLocalS7N5"; for Gymnasium, id of an environment.
        settings: options of encoder and augmentation, as in the module of the domain; `None` for
            the options that preset `leapjax` has for LEAP on this level.

    Raises:
        UserError: the domain or the level is unknown, the settings belong to another domain, or
            the environment cannot be made.
    """
    if settings is None:
        settings = find_preset(name, level, "leap", PRESET).domain_settings
    return make_level(name, level, settings)


def fit(
    demonstrations: Sequence[Demonstration] | str,
    domain: Domain,
    method: str = "leap",
    *,
    steps: int | None = None,
    seed: int = 0,
    horizon: int | None = None,
    context: int | None = None,
    model: ModelConfig | None = None,
    training: TrainingConfig | None = None,
    planner: PlannerConfig | None = None,
    settings: Any = None,
    progress: Callable[[int, dict[str, float]], None] = report_nothing,
) -> Pretrained:
    """Trains a planner on demonstrations, without saving it (see `Pretrained.save`).

    An argument that is `None` takes its value from preset `leapjax` of the command line, for the
    domain and the method. The same demonstrations, settings and seed give the same parameters on
    the same devices.

    Args:
        demonstrations: episodes, or the id of a Minari data set.
        domain: the level of the demonstrations, such as
            `leapjax.make_domain("gymnasium", "CartPole-v1")`.
        method: a name in `leapjax.methods.METHODS`.
        steps: number of training steps; `None` for `training.steps`.
        seed: seed of parameters, batches and noise, in 0 .. 2^31 - 1.
        horizon: T, number of planned actions; `None` for `planner.horizon`.
        context: K, number of past steps that the network sees.
        model: size of the network.
        training: batch size, learning rate and so on.
        planner: how to search.
        settings: options of the method, an instance of its `Settings`.
        progress: called with (step, mean metrics) every 20 steps and at the end.

    Raises:
        UserError: raised before training. The demonstrations are missing, of another domain, or
            without the rewards that the method learns from; or the method is unknown, or a
            setting is invalid.
        NonFiniteLoss: see `leapjax.training.train`.
    """
    check_kind(domain, Domain)
    if not callable(progress):
        raise UserError(f"progress must be a function of (step, metrics), got {progress!r}")
    chosen, seed = find_method(method), check_integer("seed", seed)
    name, domain_settings = domain.made_from or (None, None)
    kinds = (ModelConfig, TrainingConfig, chosen.planner, chosen.settings)
    for given, kind in zip((model, training, planner, settings), kinds, strict=True):
        if given is not None:
            check_kind(given, kind)
    given_numbers = {"steps": steps, "horizon": horizon, "context": context}
    asked = {k: check_integer(k, n) for k, n in given_numbers.items() if n is not None}
    config = find_preset(name or ANY, domain.level, method, PRESET)
    try:
        model = model or config.model
        training = training or config.training
        training = dataclasses.replace(training, steps=asked.get("steps", training.steps))
        planner = planner or config.planner
        planner = dataclasses.replace(planner, horizon=asked.get("horizon", planner.horizon))
        settings = config.method_settings if settings is None else settings
        mesh = sharding.make_mesh(training.batch // training.consecutive, jax.local_devices())
    except ValueError as error:  # a dataclass refuses a value
        raise UserError(str(error)) from None
    context = asked.get("context", config.context)
    for field, number in (("horizon", planner.horizon), ("context", context)):
        if number > domain.max_steps:
            raise UserError(
                f"{field} is {number}, longer than any episode of {domain.level}: at most "
                f"{domain.max_steps} steps",
                field,
            )
    data = _read(demonstrations, domain, seed)
    if not data and training.steps:
        raise UserError("no demonstrations: expected at least one to learn from")
    if data and learns_from_rewards(method, settings) and not any(d.rewards.any() for d in data):
        raise UserError(f"no demonstration holds a reward, and {method} learns from rewards")
    settings = measure_settings(settings, data)
    name_of_data = demonstrations if isinstance(demonstrations, str) else None
    statistics = measure_statistics(domain, data) if data else ()
    domain = apply_statistics(domain, statistics)
    specification = Specification(
        name or "", domain.level, method, context, model, training, planner,
        settings, domain_settings, find_signature(domain, model.architecture),
        Origin(PRESET, seed, len(data), name_of_data), statistics,
    )  # fmt: skip
    compilation.use_disk_cache()
    agent = pretrained.make_agent(specification, domain, mesh)
    begin, step = make_begin(agent, mesh), make_train_step(agent, mesh)
    parts = join_demonstrations(domain, data)

    last: dict[str, float] = {}

    def report(done: int, state: TrainState, means: dict[str, float]) -> None:
        del state
        last.update(means)
        progress(done, means)

    state, key = begin(seed)
    choose = windows.take_turns(sharding.replicate(parts, mesh), training.windows)
    state = train(step, state, choose, key, training.steps, report)
    if warning := judge_values(settings, data, last):
        warnings.warn(warning, stacklevel=2)
    params = jax.tree.map(jnp.asarray, sharding.to_host(state.params))
    plan = compile_planner(agent.energy, planner, encode_next=agent.encode_next)
    return Pretrained(specification, agent.energy, params, plan, domain)


def _read(
    demonstrations: Sequence[Demonstration] | str, domain: Domain, seed: int
) -> list[Demonstration]:
    """Reads the demonstrations given to `fit`, and checks each against the domain."""
    if isinstance(demonstrations, str):
        if domain.demonstrations.source is not None:
            return domain.demonstrations.source.load(demonstrations, seed).demonstrations
        return storage.load(demonstrations, domain).demonstrations
    if not isinstance(demonstrations, list | tuple):
        raise UserError(
            "demonstrations must be a list of Demonstration or the name of a data set, got "
            f"{type(demonstrations).__name__}"
        )
    return [
        storage.check_demonstration(check_kind(each, Demonstration), domain, f"demonstration {i}")
        for i, each in enumerate(demonstrations)
    ]
