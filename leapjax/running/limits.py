"""Checks a configuration before any long work."""

import math
from collections.abc import Sequence

import jax

from leapjax import checkpoints, pretrained
from leapjax.agents import leap
from leapjax.agents.returns import ReturnSettings
from leapjax.checks import check_integer, check_number
from leapjax.configuration import AnyConfig, choose_episode_seeds, make_domain, specify
from leapjax.data import seeds, storage
from leapjax.domain import Domain
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig
from leapjax.planners import GibbsConfig
from leapjax.planners.configs import check_masks, count_plans, needs_totals
from leapjax.planners.guard import SCORED_TOGETHER
from leapjax.presets import find_preset
from leapjax.rollouts import MOST_OPEN
from leapjax.running import loggers, memory
from leapjax.running.programs import choose_chunk_sizes

OUTCOME = 320  # bytes of a finished episode, while all episodes are gathered and written
COPYING = ("each", "stratified")  # ways to mask that make T copies of a window


def check(config: AnyConfig) -> None:
    """Checks that a run of a configuration can work.

    Raises:
        UserError: an option cannot work; names it.
    """
    check_counts(config, "episodes")
    if config.training.steps and config.demos < 1:
        raise UserError(
            f"--demos must be at least 1, got {config.demos}: --steps {config.training.steps} "
            "needs demonstrations to train on, and a method that learns nothing has none by default"
        )
    check_seeds(config.seeds)
    choose_episode_seeds(config)
    if not 0 <= config.demos <= seeds.TRAINING_STRIDE:
        raise UserError(f"--demos {config.demos}: at most {seeds.TRAINING_STRIDE} are possible")
    loggers.check(config.loggers)
    if config.checkpoint_seconds != math.inf:  # infinity: only at the end
        check_number("--checkpoint-seconds", config.checkpoint_seconds, 0)
    check_integer("--context", config.context)
    check_number("--rules", config.rules, 0)
    check_executed(config.executed, config.planner.horizon)
    check_target_return(config)
    checkpoints.check_path(config.runs)
    if config.play is not None and config.checkpoint is None:
        raise UserError("--play: another level is played with a --checkpoint, and there is none")
    recorded = (
        storage.describe_dataset(config.demonstrations).level if config.demonstrations else None
    )
    # `module:id` is an environment that a module registers; data sets name only the id.
    if recorded is not None and recorded != config.level.rpartition(":")[2]:
        remedy = f"use {config.flag('level')} {recorded}"
        if config.domain != "gymnasium":
            remedy += (
                f"; if {config.domain} has no such level: the program gymnasium, with --dataset "
                f"{config.demonstrations}"
            )
        raise UserError(
            f"{config.flag('demonstrations')} {config.demonstrations} is of {recorded}, not of "
            f"{config.level}: {remedy}"
        )
    domain = make_domain(config)
    if domain.held_out is not None:
        domain.held_out.check(choose_episode_seeds(config))
    made = config.demonstrations is None and config.checkpoint is None and config.demos > 0
    if made and domain.demonstrations.collect is None and domain.demonstrations.source is None:
        raise UserError(
            f"{storage.explain_no_demonstrator(domain)} ({config.flag('demonstrations')})"
        )
    if config.rules and domain.rules is None:
        raise UserError(f"--rules: {config.level} has no rules that are written as an energy")
    if config.planner.horizon > domain.max_steps:
        raise UserError(
            f"--horizon {config.planner.horizon} is longer than any episode of {config.level}: at "
            f"most {domain.max_steps} actions are executed"
        )
    if config.checkpoint is None and config.context > domain.max_steps:
        raise UserError(
            f"--context {config.context} is longer than any episode of {config.level}: at most "
            f"{domain.max_steps} steps come before a state"
        )
    check_memory(config, domain)
    # Making an agent is cheap, and raises an error for options that its method lacks.
    agent = pretrained.make_agent(specify(config, config.seeds[0], domain), domain)
    check_masks(agent.energy, config.planner)


def check_seeds(training: Sequence[int]) -> None:
    """Checks training seeds.

    Raises:
        UserError: a seed is out of range, or occurs twice.
    """
    if not training:
        raise UserError("--seeds needs at least one seed")
    for seed in training:
        seeds.training_seeds(seed)
        if training.count(seed) > 1:
            raise UserError(f"--seeds names {seed} twice: both would be one run")


def check_target_return(config: AnyConfig) -> None:
    """Checks that a model with a target return is conditioned on returns.

    Raises:
        UserError: names the missing option.
    """
    settings = config.method_settings
    if not isinstance(settings, ReturnSettings) or settings.conditioned:
        return
    default = find_preset(config.domain, config.level, config.method, config.preset).method_settings
    if settings.target_return != default.target_return:
        raise UserError(
            f"--target-return {settings.target_return}: --method {config.method} is told of "
            "returns with --returns only"
        )


def check_memory(config: AnyConfig, domain: Domain) -> None:
    """Compares the machine's memory with a lower bound on the need of a configuration.

    The bound comes from the options. `memory.check_program` measures exactly, after compilation.

    Raises:
        UserError: the memory is too small; names the options that need too much.
    """
    model, search, training = config.model, config.planner, config.training
    horizon, paper = search.horizon, model.architecture == "paper"
    observation = sum(leaf.nbytes for leaf in jax.tree.leaves(domain.blank))
    context = (observation + 8) * (config.context + 1)
    tokens = 2 * (horizon + config.context) if paper else horizon
    layer = count_layer_bytes(model, tokens)
    times = domain.max_steps if paper else 0  # each time step has an embedding
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
        settings = config.method_settings
        copied = isinstance(settings, leap.Settings) and settings.masking in COPYING
        copies = horizon if copied else 1
        together = min(training.batch, training.microbatch or training.batch)
        activations = together * copies * model.layers * layer
        needs["--batch, --context, --horizon"] = training.batch * context + activations
        source = domain.demonstrations.source
        # A demonstration has at least two states.
        states = 2 * config.demos if source is None else source.amount
        needs["--demos" if source is None else f"--{source.unit}"] = states * observation
    # The planner makes plans in one batch, and scores restarts and candidates a few at a time, with
    # T passes each.
    many = count_plans(search)
    passes = max(many, min(many, SCORED_TOGETHER) * horizon if needs_totals(search) else 1)
    plans = min(*choose_chunk_sizes(config), config.episodes)
    rounds, chosen = 1, 1  # positions are chosen in each round
    if isinstance(search, GibbsConfig):
        rounds, chosen = search.iterations, search.resampled
    choices, drawn = 4 * many * rounds, chosen * domain.num_actions + horizon
    needs["--iterations, --restarts, --beams, --candidates, --horizon"] = plans * (
        passes * layer + choices * drawn
    )
    memory.check(needs)


def count_layer_bytes(model: ModelConfig, tokens: int) -> int:
    """Returns a lower bound on the bytes of a layer's activations for a number of tokens."""
    # Queries, keys, values and so on; then the weights of attention.
    return 4 * (12 * model.width * tokens + model.heads * tokens**2)


def check_counts(options: object, *names: str) -> None:
    """Checks that options which count something are positive and not too large.

    Raises:
        UserError: an option is too small or too large; names it.
    """
    for name in names:
        check_integer(f"--{name.replace('_', '-')}", getattr(options, name), 1)


def check_executed(executed: int | None, horizon: int, of: str = "") -> None:
    """Checks that a plan has at least as many actions as a run executes.

    Raises:
        UserError: the plan is too short; names its horizon.
    """
    if executed is not None and not 1 <= executed <= horizon:
        raise UserError(f"--executed {executed} is not in 1 .. {horizon}, the horizon{of}")
