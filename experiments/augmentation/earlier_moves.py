"""Random moves before the beginning of a window."""

import jax
import jax.numpy as jnp

from leapjax.domains.babyai.adapter import END
from leapjax.domains.babyai.dynamics import FORWARD, LAVA, find_passable
from leapjax.domains.babyai.symmetries import DIRECTION_VECTORS, EMPTY, LEFT, RIGHT
from leapjax.types import Window


def prepend_moves(
    key: jax.Array, window: Window, count: jax.Array, most: int, forward: float
) -> tuple[Window, jax.Array, jax.Array]:
    """Prepends random moves to a window.

    Moves are impossible if they lead through objects or lava, past the goal, or out of a doorway,
    because the agent's mark hides the door.

    Args:
        key: random key of the moves.
        window: one training example, without past states.
        count: `[]` number of moves.
        most: largest number of moves, at least 1.
        forward: probability that a move goes forward; else it turns.

    Returns:
        The window, whose horizon cuts off its last actions; all its actions
        `[most + horizon]`, padded with ends; and whether the moves are possible, `[]`.
    """
    context, horizon = window.context, window.actions.shape[0]
    turn_key, forward_key = jax.random.split(key)
    shape = (most,)
    turns = jnp.where(jax.random.bernoulli(turn_key, shape=shape), LEFT, RIGHT)
    moves = jnp.where(jax.random.bernoulli(forward_key, forward, shape), FORWARD, turns)
    observation = context.observation
    grid, pose = jnp.asarray(observation.grid), jnp.asarray(observation.pose)
    free = find_passable(grid) & (grid[..., 0] != LAVA)
    vectors = jnp.asarray(DIRECTION_VECTORS)

    def undo(
        carry: tuple[jax.Array, jax.Array], place: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        """Finds the pose before a move, and whether the move is possible from there."""
        pose, possible = carry
        move, made = moves[place], place < count
        turn = (move == RIGHT).astype(jnp.int32) - (move == LEFT)
        behind = pose[:2] - vectors[pose[2]] * (move == FORWARD)
        before = jnp.append(behind, (pose[2] - turn) % 4)
        facing = before[:2] + vectors[before[2]]
        possible &= ~made | (free[behind[0], behind[1]] & (facing != observation.goal).any())
        pose = jnp.where(made, before, pose)
        return (pose, possible), pose

    around = jnp.pad(~free, 1, constant_values=True)
    x, y = pose[0] + 1, pose[1] + 1
    doorway = (around[x - 1, y] & around[x + 1, y]) | (around[x, y - 1] & around[x, y + 1])
    places = jnp.arange(most)[::-1]
    (start, possible), visited = jax.lax.scan(undo, (pose, ~doorway | (count == 0)), places)
    # The agent's mark, whose state is its direction, moves to the start.
    empty = jnp.array([EMPTY, 0, 0], grid.dtype)
    mark = grid[pose[0], pose[1]].at[2].set(start[2].astype(grid.dtype))
    moved = grid.at[pose[0], pose[1]].set(empty).at[start[0], start[1]].set(mark)
    place = jnp.arange(most + horizon)
    # The window's actions follow. End actions, which do not move the agent, replace unknown ones.
    own = jnp.append(window.actions, END)[jnp.clip(place - count, 0, horizon)]
    whole = jnp.where(place < count, moves[jnp.minimum(place, most - 1)], own)
    needed = window.extras.at[visited[:, 0], visited[:, 1]].set(True)
    began = observation._replace(grid=moved, pose=start)
    longer = window._replace(
        context=context._replace(observation=began), actions=whole[:horizon], extras=needed
    )
    return longer, whole, possible
