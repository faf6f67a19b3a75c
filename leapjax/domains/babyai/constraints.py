"""Constraints on plans in a grid world that no model has learned, and views that hide things.

Each penalty is `(context, actions [T]) -> []`, for `leapjax.constrain` with `partial`: the number
of violations in what is certain of the plan, or how far it is from what is asked for.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import vocabulary
from leapjax.domains.babyai.adapter import END, TURNS
from leapjax.domains.babyai.dynamics import DOOR, FLOOR, FORWARD, LAVA, OPEN, faced, roll, steps_to
from leapjax.domains.babyai.encoders.cells import mark_cell
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.symmetries import EMPTY, INTERCHANGEABLE, LEFT
from leapjax.types import Array, Context


def lava(context: Context, actions: jax.Array) -> jax.Array:
    """Steps onto lava, of the whole plan, where nothing but the agent moves: see `roll`.

    Where a plan moves things or shuts doors, and goes on there, it can be wrong either way.
    """
    return _lava_steps(context.observation, actions)


def immediate_lava(context: Context, actions: jax.Array) -> jax.Array:
    """The same of the first action alone, which is all that the paper penalises."""
    return _lava_steps(context.observation, actions[:1])


def _lava_steps(observation: Observation, actions: jax.Array) -> jax.Array:
    cells = roll(observation, actions)[:, :2]
    entered = (cells[1:] != cells[:-1]).any(axis=1)
    on_lava = jnp.asarray(observation.grid)[cells[1:, 0], cells[1:, 1], 0] == LAVA
    return jnp.sum(entered & on_lava).astype(jnp.float32)


def left_turns(context: Context, actions: jax.Array) -> jax.Array:
    """Turns to the left before the plan ends, as if they were forbidden."""
    del context
    return jnp.sum((actions == LEFT) & _before_end(actions)).astype(jnp.float32)


def turns_over(context: Context, actions: jax.Array, budget: int) -> jax.Array:
    """Turns over a budget: those that the context remembers, and those of the plan."""
    turns = jnp.array(TURNS)
    taken = jnp.isin(jnp.asarray(context.actions), turns).sum()
    planned = (jnp.isin(actions, turns) & _before_end(actions)).sum()
    return jnp.maximum(taken + planned - budget, 0).astype(jnp.float32)


def _before_end(actions: jax.Array) -> jax.Array:
    """`[T]` bool: what of a plan is executed, as far as it is certain."""
    return jnp.cumsum(actions >= END) == 0


def steps_to_visit(context: Context, actions: jax.Array) -> jax.Array:
    """How far from the coloured cell a plan ends that does not visit it, in steps; 0 if it does.

    Much farther, if it gets to the goal before.
    """
    observation = context.observation
    marked = jnp.asarray(observation.grid)[..., 0] == FLOOR
    poses = roll(observation, actions)
    visited = jnp.cumsum(marked[poses[:, 0], poses[:, 1]]) > 0
    early = (_at_goal(observation, poses) & ~visited)[1:].any()
    cell = jnp.stack(jnp.unravel_index(jnp.argmax(marked), marked.shape))
    far = jnp.where(visited[-1], 0, steps_to(poses[-1], cell)) + early * marked.size
    return jnp.where(marked.any(), far, 0).astype(jnp.float32)


def revisits(context: Context, actions: jax.Array, handling: bool = False) -> jax.Array:
    """How often the agent has been before where a plan leads, summed over its poses.

    Before is in the past that the context remembers, now, and earlier in the plan. So what leads
    nowhere costs more each time, until another way is the better one (as Korf's LRTA*, 1990). An
    end comes back to nothing.

    Args:
        context: whose past poses count.
        actions: `[T]` a plan, which may hold MASK.
        handling: whether nothing is said of actions on the thing in front, which may be of use
            though the agent stays where it is.
    """
    steps = actions.shape[0]
    observation = context.observation
    poses = roll(observation, actions)
    earlier = jnp.concatenate([jnp.asarray(context.past.pose), poses])  # [K + T + 1, 3]
    same = (poses[1:, None] == earlier).all(axis=-1)  # [T, K + T + 1]; a blank pose is in no cell
    now = len(earlier) - steps - 1
    before = jnp.arange(len(earlier)) <= now + jnp.arange(steps)[:, None]
    times = jnp.sum(same & before, axis=1) * _before_end(actions)
    if handling:
        times *= ~((actions > FORWARD) & _before_a_thing(observation, poses[:-1]))
    return jnp.sum(times).astype(jnp.float32)


def _before_a_thing(observation: Observation, poses: jax.Array) -> jax.Array:
    """`[n]` bool: at which of the poses `[n, 3]` an agent faces a door or an object."""
    x, y = faced(poses).T
    kinds = jnp.asarray(observation.grid)[x, y, 0]
    return (kinds >= DOOR) & (kinds <= INTERCHANGEABLE[-1])


def goal_before_visit(context: Context, actions: jax.Array) -> jax.Array:
    """Whether the first action leads to the goal while a coloured cell is left: 1, or 0."""
    observation = context.observation
    poses = roll(observation, actions[:1])
    left = (jnp.asarray(observation.grid)[..., 0] == FLOOR).any()
    return (left & _at_goal(observation, poses[1:]).any()).astype(jnp.float32)


def _at_goal(observation: Observation, poses: jax.Array) -> jax.Array:
    """`[n]` bool: at which of the poses `[n, 3]` an agent faces the goal, or a thing like it.

    An instruction that names a kind and a colour is done at any such thing, not at the nearest.
    """
    grid, goal = jnp.asarray(observation.grid), jnp.asarray(observation.goal)
    alike = (grid[..., :2] == grid[goal[0], goal[1], :2]).all(axis=-1) & (goal[0] >= 0)
    x, y = faced(poses).T
    return alike[x, y]


def without_lava(context: Context) -> Context:
    """A context in which lava cells look empty."""
    return _hiding(context, lambda grid, goal: grid[..., 0] == LAVA)


def without_marks(context: Context) -> Context:
    """A context in which coloured cells look empty."""
    return _hiding(context, lambda grid, goal: grid[..., 0] == FLOOR)


def without_open_doors(context: Context) -> Context:
    """A context in which open doors look empty, for models that never saw a door."""
    return _hiding(context, lambda grid, goal: (grid[..., 0] == DOOR) & (grid[..., 2] == OPEN))


def half_of_obstacles(context: Context, part: int) -> Context:
    """A context in which every second object that is not the goal is seen: part 0 or 1.

    In reading order: where one is taken away, those that come after it change parts.
    """
    return _hiding(context, lambda grid, goal: in_half(grid, goal, 1 - part))


def in_half(grid: Array, goal: Array, part: int) -> jax.Array:
    """Where in a grid `[S, S, 3]` the obstacles of part 0 or 1 are: `[S, S]` bool."""
    kinds = jnp.asarray(grid)[..., 0]
    objects = (kinds >= INTERCHANGEABLE[0]) & (kinds <= INTERCHANGEABLE[-1])
    obstacles = objects & (mark_cell(jnp.asarray(goal), kinds.shape[0]) == 0)
    count = jnp.cumsum(obstacles.reshape(-1)).reshape(obstacles.shape)
    return obstacles & (count % 2 == part)


def _hiding(context: Context, which: Callable[[jax.Array, jax.Array], jax.Array]) -> Context:
    """A context in which some cells look empty, now and in the past.

    Args:
        context: of one trajectory.
        which: (grid `[S, S, 3]`, goal `[2]`) -> `[S, S]` bool.
    """

    def hide(observation: Observation) -> Observation:
        grid = jnp.asarray(observation.grid)
        hidden = which(grid, jnp.asarray(observation.goal))
        empty = jnp.array([EMPTY, 0, 0], grid.dtype)
        return observation._replace(grid=jnp.where(hidden[..., None], empty, grid))

    observation = hide(context.observation)
    return context._replace(observation=observation, past=jax.vmap(hide)(context.past))


def told_to_go(context: Context) -> Context:
    """A context whose instruction, to pick something up, is to go to it."""
    words = jnp.arange(vocabulary.SIZE)
    for said, instead in (("pick", "go"), ("up", "to")):
        words = words.at[vocabulary.WORD_IDS[said]].set(vocabulary.WORD_IDS[instead])

    def tell(observation: Observation) -> Observation:
        return observation._replace(instruction=words[jnp.asarray(observation.instruction)])

    return context._replace(observation=tell(context.observation), past=tell(context.past))
