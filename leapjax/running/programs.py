"""Compiles the programs of a run in the background, while the run makes its data."""

import concurrent.futures
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
from jax.sharding import Mesh

from leapjax import pretrained, sharding, training
from leapjax.agents.batches import make_blank_steps
from leapjax.batching import VARYING_CHUNK_SIZES, CompiledPlanner, compile_planner
from leapjax.configuration import AnyConfig
from leapjax.errors import UserError
from leapjax.planners.configs import passes_vary
from leapjax.pretrained import Pretrained
from leapjax.running import memory
from leapjax.training import TrainStep
from leapjax.types import Agent, TrainState

if TYPE_CHECKING:
    from leapjax.running.run import Run

# Number of plans in a chunk. A single chunk size needs a single program, which compiles soon.
# Larger chunks are a tenth faster, but suit the last episodes of an evaluation less.
PLANS_TOGETHER = 32


class Programs(NamedTuple):
    """The compiled programs of a run.

    Attributes:
        agent: agent of the run's method.
        begin: (seed) -> the first training state, and the key of all batches.
        step: performs one step of training.
        plan: makes plans.
    """

    agent: Agent
    begin: Callable[[int], tuple[TrainState, jax.Array]]
    step: TrainStep
    plan: CompiledPlanner


class BackgroundPrograms:
    """Compiles the programs of a run, once, in background threads."""

    def __init__(self) -> None:
        self._wait: Callable[[], Programs] | None = None

    def begin(self, run: "Run") -> None:
        """Starts to compile, unless it has started."""
        if self._wait is None:
            self._wait = _compile(run)

    def take(self, run: "Run") -> Programs:
        """Waits for the compiled programs, and returns them."""
        self.begin(run)
        assert self._wait is not None
        return self._wait()


def _compile(run: "Run") -> Callable[[], Programs]:
    """Starts to compile in the background; returns a function that waits for the programs."""
    config, domain = run.config, run.domain
    plays = run.plays and not config.rules  # with rules, `add_rules` makes another planner
    mesh = make_mesh(config)
    agent = pretrained.make_agent(run.specification, domain, mesh)
    plan = compile_planner(
        agent.energy, config.planner, choose_chunk_sizes(config), encode_next=agent.encode_next
    )
    like = make_blank_steps(domain) if config.demos else ()
    state = jax.eval_shape(agent.init, jax.random.key(0))
    memory.check_state(state)

    def compile_training() -> tuple[Any, TrainStep]:
        if config.training.steps and domain.split is None:  # else a program for each part
            begin, step = training.compile_ahead(agent, mesh, like)
            memory.check_program(step.update)
            return begin, step
        return training.make_begin(agent, mesh), training.make_train_step(agent, mesh)

    def compile_planning() -> None:
        params = jax.tree.map(lambda x: jax.numpy.zeros(x.shape, x.dtype), state.params)
        blank = Pretrained(run.specification, agent.energy, params, plan, domain)
        blank.compile(config.episodes, config.executed)

    pool = concurrent.futures.ThreadPoolExecutor(2)
    compiled = pool.submit(compile_training)
    warm = pool.submit(compile_planning) if plays else None
    pool.shutdown(wait=False)

    def wait() -> Programs:
        begun = time.perf_counter()
        begin, step = compiled.result()
        if warm is not None:
            warm.result()
        run.seconds["compile"] += time.perf_counter() - begun
        return Programs(agent, begin, step, plan)

    return wait


def choose_chunk_sizes(config: AnyConfig) -> tuple[int, ...]:
    """Returns the size of a run's chunks of plans, in a tuple."""
    most = VARYING_CHUNK_SIZES[-1] if passes_vary(config.planner) else PLANS_TOGETHER
    return (min(most, 1 << (config.episodes - 1).bit_length()),)


def make_mesh(config: AnyConfig) -> Mesh:
    """Makes the mesh of the devices of all processes that a run trains on.

    Raises:
        UserError: the devices cannot share the batch.
    """
    try:
        examples = config.training.batch // config.training.consecutive
        return sharding.make_mesh(examples, jax.devices(), config.cluster.fsdp)
    except ValueError as error:
        raise UserError(f"--batch, --fsdp: {error}") from None
