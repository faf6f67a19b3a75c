"""Constraints on plans in a grid world, and views of contexts that hide unknown objects.

They adapt models that never saw these constraints or objects. A penalty is a function
`(context, actions [T]) -> []`, for `leapjax.constrain` with `partial`. It counts violations among
the chosen actions of a plan, or measures the plan's distance from a requirement.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import vocabulary
from leapjax.domains.babyai.adapter import END, TURNS
from leapjax.domains.babyai.dynamics import (
    DOOR,
    FLOOR,
    FORWARD,
    LAVA,
    OPEN,
    count_steps,
    find_faced_cells,
    roll,
)
from leapjax.domains.babyai.encoders.cells import mark_cell
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.symmetries import EMPTY, INTERCHANGEABLE, LEFT, is_coloured
from leapjax.types import Array, Context


def lava(context: Context, actions: jax.Array) -> jax.Array:
    """Counts the steps of a plan onto lava.

    It assumes that only the agent moves (see `roll`): the count may be wrong if the plan moves
    objects or shuts doors.
    """
    return _count_lava_steps(context.observation, actions)


def immediate_lava(context: Context, actions: jax.Array) -> jax.Array:
    """Counts a step onto lava by the first action only, as the paper does."""
    return _count_lava_steps(context.observation, actions[:1])


def _count_lava_steps(observation: Observation, actions: jax.Array) -> jax.Array:
    cells = roll(observation, actions)[:, :2]
    entered = (cells[1:] != cells[:-1]).any(axis=1)
    on_lava = jnp.asarray(observation.grid)[cells[1:, 0], cells[1:, 1], 0] == LAVA
    return jnp.sum(entered & on_lava).astype(jnp.float32)


def left_turns(context: Context, actions: jax.Array) -> jax.Array:
    """Counts the turns to the left before the plan ends."""
    del context
    return jnp.sum((actions == LEFT) & _mark_executed(actions)).astype(jnp.float32)


def turns_over(context: Context, actions: jax.Array, budget: int) -> jax.Array:
    """Counts by how much the turns in the context and in the plan exceed a budget."""
    turns = jnp.array(TURNS)
    taken = jnp.isin(jnp.asarray(context.actions), turns).sum()
    planned = (jnp.isin(actions, turns) & _mark_executed(actions)).sum()
    return jnp.maximum(taken + planned - budget, 0).astype(jnp.float32)


def _mark_executed(actions: jax.Array) -> jax.Array:
    """Marks the actions of a plan `[T]` before its end and before its first MASK: `[T]` bool."""
    return jnp.cumsum(actions >= END) == 0


def steps_to_visit(context: Context, actions: jax.Array) -> jax.Array:
    """Counts the steps from the end of a plan to the coloured cell; 0 if the plan visits it.

    Adds the number of cells of the grid if the plan reaches the goal first.
    """
    observation = context.observation
    marked = jnp.asarray(observation.grid)[..., 0] == FLOOR
    poses = roll(observation, actions)
    visited = jnp.cumsum(marked[poses[:, 0], poses[:, 1]]) > 0
    early = (_find_goal_poses(observation, poses) & ~visited)[1:].any()
    cell = jnp.stack(jnp.unravel_index(jnp.argmax(marked), marked.shape))
    far = jnp.where(visited[-1], 0, count_steps(poses[-1], cell)) + early * marked.size
    return jnp.where(marked.any(), far, 0).astype(jnp.float32)


def count_revisits(context: Context, actions: jax.Array, handling: bool = False) -> jax.Array:
    """Sums over the poses of a plan how often the agent was in each pose before.

    Earlier poses are the past poses of the context, the current pose, and earlier poses of the
    plan. A dead end costs more each time, until another path costs less (as in Korf's LRTA*, 1990).
    The end action adds no pose.

    Args:
        context: context with the past poses.
        actions: plan `[T]`, which may hold MASK.
        handling: whether to ignore actions on a door or object in front. They may be useful,
            although the pose does not change.
    """
    steps = actions.shape[0]
    observation = context.observation
    poses = roll(observation, actions)
    earlier = jnp.concatenate([jnp.asarray(context.past.pose), poses])  # [K + T + 1, 3]
    same = (poses[1:, None] == earlier).all(axis=-1)  # [T, K + T + 1]; blank poses never match
    now = len(earlier) - steps - 1
    before = jnp.arange(len(earlier)) <= now + jnp.arange(steps)[:, None]
    times = jnp.sum(same & before, axis=1) * _mark_executed(actions)
    if handling:
        times *= ~((actions > FORWARD) & _find_thing_poses(observation, poses[:-1]))
    return jnp.sum(times).astype(jnp.float32)


def _find_thing_poses(observation: Observation, poses: jax.Array) -> jax.Array:
    """Marks the poses `[n, 3]` in which an agent faces a door or an object: `[n]` bool."""
    x, y = find_faced_cells(poses).T
    kinds = jnp.asarray(observation.grid)[x, y, 0]
    return is_coloured(kinds)


def goal_before_visit(context: Context, actions: jax.Array) -> jax.Array:
    """Returns 1 if the first action reaches the goal while a coloured cell is left, else 0."""
    observation = context.observation
    poses = roll(observation, actions[:1])
    left = (jnp.asarray(observation.grid)[..., 0] == FLOOR).any()
    return (left & _find_goal_poses(observation, poses[1:]).any()).astype(jnp.float32)


def _find_goal_poses(observation: Observation, poses: jax.Array) -> jax.Array:
    """Marks the poses `[n, 3]` in which an agent faces the goal or an object like it: `[n]` bool.

    Any object with the target's kind and colour completes an instruction, not only the nearest.
    """
    grid, goal = jnp.asarray(observation.grid), jnp.asarray(observation.goal)
    alike = (grid[..., :2] == grid[goal[0], goal[1], :2]).all(axis=-1) & (goal[0] >= 0)
    x, y = find_faced_cells(poses).T
    return alike[x, y]


def hide_lava(context: Context) -> Context:
    """Makes lava cells of a context look empty."""
    return _hide_cells(context, lambda grid, goal: grid[..., 0] == LAVA)


def hide_marks(context: Context) -> Context:
    """Makes coloured cells of a context look empty."""
    return _hide_cells(context, lambda grid, goal: grid[..., 0] == FLOOR)


def hide_open_doors(context: Context) -> Context:
    """Makes open doors of a context look empty, for models that never saw a door."""
    return _hide_cells(context, lambda grid, goal: (grid[..., 0] == DOOR) & (grid[..., 2] == OPEN))


def hide_half_of_obstacles(context: Context, part: int) -> Context:
    """Makes every second obstacle of a context look empty, and leaves part 0 or 1.

    Parts alternate in reading order. If an obstacle moves, later obstacles may change parts.
    """
    return _hide_cells(context, lambda grid, goal: find_half(grid, goal, 1 - part))


def find_half(grid: Array, goal: Array, part: int) -> jax.Array:
    """Finds the obstacles of part 0 or 1 in a grid `[S, S, 3]`: `[S, S]` bool.

    An obstacle is an object other than the goal.
    """
    kinds = jnp.asarray(grid)[..., 0]
    objects = (kinds >= INTERCHANGEABLE[0]) & (kinds <= INTERCHANGEABLE[-1])
    obstacles = objects & (mark_cell(jnp.asarray(goal), kinds.shape[0]) == 0)
    count = jnp.cumsum(obstacles.reshape(-1)).reshape(obstacles.shape)
    return obstacles & (count % 2 == part)


def _hide_cells(context: Context, which: Callable[[jax.Array, jax.Array], jax.Array]) -> Context:
    """Makes some cells of a context look empty, now and in the past.

    Args:
        context: context of one trajectory.
        which: (grid `[S, S, 3]`, goal `[2]`) -> cells to hide, `[S, S]` bool.
    """

    def hide(observation: Observation) -> Observation:
        grid = jnp.asarray(observation.grid)
        hidden = which(grid, jnp.asarray(observation.goal))
        empty = jnp.array([EMPTY, 0, 0], grid.dtype)
        return observation._replace(grid=jnp.where(hidden[..., None], empty, grid))

    observation = hide(context.observation)
    return context._replace(observation=observation, past=jax.vmap(hide)(context.past))


def replace_pick_up(context: Context) -> Context:
    """Replaces 'pick up' in the instruction of a context by 'go to'."""
    words = jnp.arange(vocabulary.SIZE)
    for word, other in (("pick", "go"), ("up", "to")):
        words = words.at[vocabulary.WORD_IDS[word]].set(vocabulary.WORD_IDS[other])

    def tell(observation: Observation) -> Observation:
        return observation._replace(instruction=words[jnp.asarray(observation.instruction)])

    return context._replace(observation=tell(context.observation), past=tell(context.past))
