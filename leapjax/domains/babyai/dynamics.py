"""Pure functions that compute the poses of a moving agent, for constraints on plans."""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai.adapter import ACTIONS, END
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.symmetries import AGENT, DIRECTION_VECTORS, EMPTY, LEFT, RIGHT

FORWARD = ACTIONS.index("forward")
FLOOR, DOOR, GOAL, LAVA = 3, 4, 8, 9  # MiniGrid's object indices; a floor is a coloured cell
OPEN, LOCKED = 0, 2  # MiniGrid's states of a door; 1 is closed
PASSABLE = (EMPTY, FLOOR, GOAL, LAVA, AGENT)  # the agent's mark hides the cell below


def find_passable(grid: jax.Array) -> jax.Array:
    """Finds the cells that an agent can step into: `[S, S]` bool."""
    kind, state = grid[..., 0], grid[..., 2]
    return jnp.isin(kind, jnp.array(PASSABLE)) | ((kind == DOOR) & (state == OPEN))


def roll(observation: Observation, actions: jax.Array) -> jax.Array:
    """Computes the poses that a plan leads through if only the agent moves.

    Doors and objects do not change, even if the plan acts on them, and the agent can cross lava. It
    stops at the end action and at the first MASK.

    Args:
        observation: current state.
        actions: plan `[T]`, which may hold MASK.

    Returns:
        `[T + 1, 3]` int32: x, y and direction before the first action, and after each action.
    """
    free = find_passable(jnp.asarray(observation.grid))
    vectors = jnp.asarray(DIRECTION_VECTORS)

    def move(
        carry: tuple[jax.Array, jax.Array], action: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        pose, over = carry
        over |= action >= END
        turn = (action == RIGHT).astype(jnp.int32) - (action == LEFT)
        ahead = pose[:2] + vectors[pose[2]]
        moves = (action == FORWARD) & free[ahead[0], ahead[1]]
        moved = jnp.append(jnp.where(moves, ahead, pose[:2]), (pose[2] + turn) % 4)
        pose = jnp.where(over, pose, moved)
        return (pose, over), pose

    start = jnp.asarray(observation.pose)
    _, poses = jax.lax.scan(move, (start, jnp.bool_(False)), actions)
    return jnp.concatenate([start[None], poses])


def find_faced_cells(poses: jax.Array) -> jax.Array:
    """Finds the cells in front of an agent at poses `[n, 3]`: `[n, 2]` int32."""
    return poses[:, :2] + jnp.asarray(DIRECTION_VECTORS)[poses[:, 2]]


def count_steps(pose: jax.Array, cell: jax.Array) -> jax.Array:
    """Counts turns and moves from a pose `[3]` to a cell `[2]` on a free grid: `[]` int32."""
    offset = jnp.asarray(cell) - pose[:2]
    ahead = offset @ jnp.asarray(DIRECTION_VECTORS)[pose[2]]
    moves = jnp.abs(offset).sum()
    turns = jnp.where(ahead < 0, 2, moves > jnp.abs(ahead))
    return moves + turns
