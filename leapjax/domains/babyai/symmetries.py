"""Symmetries of a grid world and of its language, as pure functions.

MiniGrid's dynamics are equivariant: stepping then transforming equals transforming then stepping. A
reflection also exchanges the two turns. Grids must be square. Names can be exchanged, and a
sequence of tasks can be told from its beginning or from its end.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.domains.babyai.observations import Observation

DIRECTION_VECTORS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], np.int32)  # [4, 2]
LEFT, RIGHT, DROP = 0, 1, 4  # MiniGrid's actions
EMPTY = 1  # MiniGrid's object index of an empty cell
COLOURS = 6  # number of MiniGrid's colours
FIRST_COLOURED, LAST_COLOURED = 4, 7  # MiniGrid's object indices: door, key, ball, box
# Key, ball and box behave alike unless a door is locked, or the agent toggles a box (it vanishes).
INTERCHANGEABLE = (5, 6, 7)
AGENT = 10  # MiniGrid's object index of the agent; the state of its cell is its direction


@functools.lru_cache
def _sources(side: int) -> np.ndarray:
    """Computes the flat index of the cell that each cell comes from, by number of quarter turns."""
    cells = np.arange(side * side).reshape(side, side)
    return np.stack([np.rot90(cells, -quarter).reshape(-1) for quarter in range(4)])


def rotate_position(position: jax.Array, quarters: jax.Array, side: int) -> jax.Array:
    """Turns a position `[2]` counter-clockwise by `quarters` quarter turns; -1 stays -1."""
    x, y = position[0], position[1]
    far = side - 1
    turned = jnp.stack(
        [
            jnp.stack([x, y]),
            jnp.stack([y, far - x]),
            jnp.stack([far - x, far - y]),
            jnp.stack([far - y, x]),
        ]
    )[quarters % 4]
    return jnp.where(x < 0, position, turned)


def rotate_pose(pose: jax.Array, quarters: jax.Array, side: int) -> jax.Array:
    """Turns a pose `[3]` counter-clockwise by quarter turns; direction 1 becomes 0 after one."""
    position = rotate_position(pose[:2], quarters, side)
    return jnp.append(position, (pose[2] - quarters) % 4)


def rotate(observation: Observation, quarters: jax.Array) -> Observation:
    """Turns the world counter-clockwise by quarter turns; `quarters [] int32` may be traced.

    A turn by the agent's own direction makes it face right. Instructions do not change, because
    their words are relative to the agent.
    """
    side = observation.grid.shape[0]
    source = jnp.asarray(_sources(side))[quarters % 4]
    grid = observation.grid.reshape(side * side, 3)[source].reshape(side, side, 3)
    return observation._replace(
        grid=_turn_agent(grid, lambda direction: (direction - quarters) % 4),
        pose=rotate_pose(observation.pose, quarters, side),
        goal=rotate_position(observation.goal, quarters, side),
    )


def reflect(observation: Observation, mirrored_words: jax.Array) -> Observation:
    """Mirrors the world top to bottom: y becomes S - 1 - y, left turns become right turns.

    Args:
        observation: state to mirror.
        mirrored_words: ids `[vocabulary]` of the word that each word becomes (left and right).
    """
    side = observation.grid.shape[0]

    def mirror(position: jax.Array) -> jax.Array:
        flipped = position.at[1].set(side - 1 - position[1])
        return jnp.where(position[0] < 0, position, flipped)

    return observation._replace(
        grid=_turn_agent(observation.grid[:, ::-1], lambda direction: -direction % 4),
        pose=jnp.append(mirror(observation.pose[:2]), -observation.pose[2] % 4),
        goal=mirror(observation.goal),
        instruction=mirrored_words[observation.instruction],
    )


def reflect_actions(actions: jax.Array) -> jax.Array:
    """Exchanges the two turns, and leaves all other tokens unchanged."""
    return jnp.where(actions == LEFT, RIGHT, jnp.where(actions == RIGHT, LEFT, actions))


def is_coloured(kinds: jax.Array) -> jax.Array:
    """Returns whether object indices are of a door, key, ball or box, whose colour has a name."""
    return (kinds >= FIRST_COLOURED) & (kinds <= LAST_COLOURED)


class Renaming(NamedTuple):
    """Permutations of colours and kinds of objects, in the grid and in the language.

    Attributes:
        colours: the colour that each colour becomes, `[6]` int32.
        objects: the object that each object becomes, `[11]` int32.
        words: the word that each word becomes, `[vocabulary]` int32.
    """

    colours: jax.Array
    objects: jax.Array
    words: jax.Array


def rename(observation: Observation, renaming: Renaming) -> Observation:
    """Exchanges colours and kinds of objects in the grid, the hands and the instruction."""
    kinds, colours = observation.grid[..., 0], observation.grid[..., 1]
    # Only objects with a colour in the language change colour: walls stay grey.
    coloured = is_coloured(kinds)
    new_kinds = renaming.objects[kinds].astype(kinds.dtype)
    new_colours = renaming.colours[colours].astype(colours.dtype)
    grid = observation.grid.at[..., 0].set(new_kinds)
    grid = grid.at[..., 1].set(jnp.where(coloured, new_colours, colours))
    held, held_colour = observation.carried[0], observation.carried[1]
    recoloured = jnp.where(held > 0, renaming.colours[held_colour], held_colour)
    return observation._replace(
        grid=grid,
        carried=jnp.stack([renaming.objects[held], recoloured]),
        instruction=renaming.words[observation.instruction],
    )


def restate(instruction: jax.Array, then: jax.Array, after: jax.Array) -> jax.Array:
    """Replaces "A, then B" by the equivalent "B after you A", and vice versa.

    Args:
        instruction: token ids `[L]`, 0 pads on the right; unchanged if it has neither phrase.
        then: ids `[2]` of ", then".
        after: ids `[2]` of "after you".
    """
    place = jnp.arange(instruction.shape[0])
    joins = (instruction == then[0]) | (instruction == after[0])
    first = jnp.argmax(joins)  # tokens of the first part
    second = jnp.sum(instruction > 0) - first - 2  # tokens of the second part
    swapped = instruction[jnp.where(place < second, place + first + 2, place - second - 2)]
    join = jnp.where(instruction[first] == then[0], after, then)
    swapped = jnp.where(place == second, join[0], swapped)
    swapped = jnp.where(place == second + 1, join[1], swapped)
    return jnp.where(joins.any() & (instruction > 0), swapped, instruction)


def _turn_agent(grid: jax.Array, turn: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """Turns the agent's direction, which is the state of its cell."""
    state = grid[..., 2]
    turned = turn(state.astype(jnp.int32)).astype(grid.dtype)
    return grid.at[..., 2].set(jnp.where(grid[..., 0] == AGENT, turned, state))
