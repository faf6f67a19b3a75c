"""Trained planners on disk: what `leapjax.load` reads and every run writes."""

import dataclasses
import json
import os
from pathlib import Path

import jax
from jax.sharding import Mesh

from leapjax import checkpoints, planners
from leapjax.agents import leap
from leapjax.agents.leap import TrainingConfig
from leapjax.batching import CompiledPlanner, compile_planner
from leapjax.envs import levels, vocabulary
from leapjax.envs.adapter import NUM_ACTIONS
from leapjax.envs.levels import Level
from leapjax.errors import UserError
from leapjax.files import write_text
from leapjax.models.trajectory import ModelConfig, Sizes
from leapjax.planners import GibbsConfig
from leapjax.types import Agent, Array, Context, Energy, Params, Plan

SPECIFICATION = "specification.json"
CHECKPOINTS = "checkpoints"


@dataclasses.dataclass(frozen=True)
class Specification:
    """All that is needed to rebuild a planner around its parameters."""

    level: str
    model: ModelConfig
    sizes: Sizes
    training: TrainingConfig
    planner: GibbsConfig
    words: int  # L
    vocabulary: tuple[str, ...]  # words by id, so that a later version cannot misread them


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


def sizes_for(level: Level, context: int, horizon: int) -> Sizes:
    """What a model must know of a level; makes the level once to look at it."""
    env = levels.make_environment(level)
    side = max(env.width, env.height)
    # The limit grows with the navigations that an instruction needs; 4 clauses of 2 at most.
    navigations = 1 if level.words <= vocabulary.LONGEST_CLAUSE else 8
    longest = navigations * env.room_size**2 * env.num_rows * env.num_cols
    return Sizes(side, vocabulary.SIZE, NUM_ACTIONS, context, horizon, longest)


def make_agent(specification: Specification, mesh: Mesh | None = None) -> Agent:
    """The agent of a specification; for `mesh` see `leapjax.agents.leap.make_agent`."""
    return leap.make_agent(
        specification.model, specification.training, specification.planner,
        specification.sizes, specification.words, mesh,
    )  # fmt: skip


def save_specification(folder: Path, specification: Specification) -> None:
    """Writes the specification of a run, atomically."""
    write_text(folder / SPECIFICATION, json.dumps(dataclasses.asdict(specification), indent=1))


def read_specification(folder: Path) -> Specification:
    """The specification that a run left in its folder.

    Raises:
        UserError: missing, damaged, or made with another vocabulary.
    """
    path = folder / SPECIFICATION
    if not path.is_file():
        raise UserError(
            f"{folder} is not a checkpoint: expected the folder of a run, with {SPECIFICATION}"
        )
    values = checkpoints.read_json(path)
    try:
        specification = checkpoints.from_json(Specification, values)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    if specification.vocabulary != vocabulary.WORDS:
        raise UserError(f"{path}: trained with another vocabulary; train it again")
    return specification


def load(path: str | os.PathLike[str], planner: planners.PlannerConfig | None = None) -> Pretrained:
    """A trained planner from the folder of its run.

    Args:
        path: the folder that a run printed.
        planner: search settings; None for those it was trained with.

    Raises:
        UserError: no such run, or one that cannot be read.
    """
    folder = Path(path)
    specification = read_specification(folder)
    agent = make_agent(specification)
    like = jax.eval_shape(agent.init, jax.random.key(0)).params
    params = checkpoints.restore_params(folder / CHECKPOINTS, like)
    assert agent.energy is not None
    plan = compile_planner(agent.energy, planner or specification.planner)
    return Pretrained(specification, agent.energy, params, plan)
