"""More windows from the same demonstrations: symmetries of the world, and clutter in it.

The extras of a window are its way: `[S, S]` bool, the cells that the demonstration needs free
from here on.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.domain import Augmentation
from leapjax.domains.babyai import symmetries, vocabulary
from leapjax.domains.babyai.adapter import END
from leapjax.domains.babyai.dynamics import DOOR, FORWARD, LAVA, passable
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from leapjax.domains.babyai.symmetries import DIRECTION_VECTORS, EMPTY, LEFT, RIGHT
from leapjax.types import Array, Context, Demonstration, Window

FALSE_MOVES, DETOUR_MOVES = 6, 8  # at most, at the beginning of a window
TRIES = 8  # to find a detour
WALL, GREY = 2, 5  # MiniGrid's indices


class GridWords(NamedTuple):
    """Which token ids name what, for the symmetries of a world with instructions."""

    colours: Array  # [6] int32, in MiniGrid's order of colours
    objects: Array  # [3] int32: key, ball, box
    mirrored: Array  # [vocabulary] int32: the word that each word becomes in a mirror
    then: Array  # [2] int32: ", then"
    after: Array  # [2] int32: "after you"


def grid_words() -> GridWords:
    """The words of BabyAI's vocabulary that name what."""
    return GridWords(
        vocabulary.colour_words(),
        vocabulary.object_words(symmetries.INTERCHANGEABLE),
        vocabulary.mirrored_words(),
        *vocabulary.joining_words(),
    )


def chosen(settings: Settings) -> list[Augmentation]:
    """The augmentations that are asked for, the one that comes last first."""
    found: list[Augmentation] = []
    if settings.augment:
        found.append(lambda key, w: augment(key, w, grid_words(), settings.exchange_objects))
    if settings.false_starts:
        found.append(lambda key, w: false_start(key, w, settings.false_starts))
    if settings.detours:
        found.append(lambda key, w: detour(key, w, settings.detours, grid_words()))
    if settings.clutter:
        lookalikes = grid_words() if settings.lookalikes else None
        found.append(lambda key, w: clutter(key, w, settings.clutter, lookalikes))
    return found


def way(demonstration: Demonstration) -> np.ndarray:
    """`[n, S, S]` bool: where the agent stands, or puts something down, from each step on."""
    poses, actions = demonstration.observations.pose, demonstration.actions
    needed = np.zeros((len(poses), *demonstration.observations.grid.shape[1:3]), bool)
    needed[np.arange(len(poses)), poses[:, 0], poses[:, 1]] = True
    drops = np.flatnonzero(actions == symmetries.DROP)
    front = poses[drops, :2] + symmetries.DIRECTION_VECTORS[poses[drops, 2]]
    front = front.clip(0, needed.shape[1] - 1)  # a user's data may face out of the grid
    needed[drops, front[:, 0], front[:, 1]] = True
    return np.logical_or.accumulate(needed[::-1])[::-1][:-1]


def clutter(
    key: jax.Array, window: Window, share: float, lookalikes: GridWords | None = None
) -> Window:
    """A window with objects where the demonstration never goes.

    The shortest way stays the shortest when others are blocked, so the demonstration stays as
    good as it was; what changes is what it shows: that ways lead around things. (Not where actions
    are replaced by random ones: up to one in 120 windows then handles what was put there.)

    Half of the windows stay as they are; in the others each free cell gets an object with a
    probability that is drawn for the window, in 0 .. `share`. Kind and colour both differ from
    the target's, so that no instruction means the new object; with `lookalikes`, where the
    instruction names both, one of them may be the same. Windows without a goal stay as they are,
    because what their instruction means is not known here.

    Args:
        key: chooses.
        window: one training example.
        share: of the cells that nobody needs, in 0 .. 1.
        lookalikes: the words that name kinds and colours; None for none.
    """
    share_key, where_key, kind_key, colour_key = jax.random.split(key, 4)
    context = window.context
    grid, past, goal = context.observation.grid, context.past.grid, context.observation.goal
    cells = grid.shape[:2]
    # Free now and in all of the past, of which cells before the start are all zero.
    free = (grid[..., 0] == symmetries.EMPTY) & (past[..., 0] <= symmetries.EMPTY).all(axis=0)
    probability = share * jax.random.uniform(share_key, minval=-1.0)  # negative: none
    filled = jax.random.uniform(where_key, cells) < probability
    filled &= free & ~window.extras & (goal[0] >= 0)
    target = _target(context)
    if lookalikes is None:
        kind, colour = _unlike(kind_key, colour_key, target, cells)
    else:
        said = context.observation.instruction
        kind, colour = _other(
            kind_key, colour_key, target, cells, _in_full(said, target, lookalikes)
        )
    objects = jnp.stack([kind, colour, jnp.zeros_like(kind)], axis=-1).astype(grid.dtype)

    def fill(image: jax.Array) -> jax.Array:
        known = image[..., 0] == symmetries.EMPTY
        return jnp.where((filled & known)[..., None], objects, image)

    observation = context.observation._replace(grid=fill(grid))
    before = context.past._replace(grid=jax.vmap(fill)(past))
    return window._replace(context=context._replace(observation=observation, past=before))


def _target(context: Context) -> jax.Array:
    """`[3]` int32: what is on the goal's cell, or was there before it was picked up."""
    x, y = context.observation.goal
    now = jnp.asarray(context.observation.grid)[x, y]
    seen = jnp.concatenate([jnp.asarray(context.past.grid)[:, x, y], now[None]])  # [K + 1, 3]
    thing = (seen[:, 0] >= DOOR) & (seen[:, 0] <= symmetries.INTERCHANGEABLE[-1])
    last = jnp.argmax(thing * jnp.arange(1, len(seen) + 1))
    return seen[last].astype(jnp.int32)


def _unlike(
    kind_key: jax.Array, colour_key: jax.Array, target: jax.Array, cells: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Kinds and colours `[S, S]`, none of them that of the target `[3]`."""
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    # Not the target's: a shift by at least one, around a circle.
    shift = jax.random.randint(kind_key, cells, 1, len(kinds))
    kind = kinds[(target[0] - kinds[0] + shift) % len(kinds)]
    shift = jax.random.randint(colour_key, cells, 1, symmetries.COLOURS)
    return kind, (target[1] + shift) % symmetries.COLOURS


def _other(
    kind_key: jax.Array,
    colour_key: jax.Array,
    target: jax.Array,
    cells: tuple[int, ...],
    in_full: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The same, but that one of the two may be the target's where the instruction names both."""
    kinds, count = jnp.array(symmetries.INTERCHANGEABLE), len(symmetries.INTERCHANGEABLE)
    # Any pair but the target's, all alike.
    pair = (target[0] - kinds[0]) * symmetries.COLOURS + target[1]
    every = count * symmetries.COLOURS
    other = (pair + jax.random.randint(kind_key, cells, 1, every)) % every
    kind, colour = _unlike(kind_key, colour_key, target, cells)
    return (
        jnp.where(in_full, kinds[other // symmetries.COLOURS], kind),
        jnp.where(in_full, other % symmetries.COLOURS, colour),
    )


def _in_full(instruction: jax.Array, target: jax.Array, words: GridWords) -> jax.Array:
    """Whether an instruction `[L]` names both the kind and the colour of the target `[3]`."""
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    kind = jnp.asarray(words.objects)[jnp.argmax(kinds == target[0])]
    colour = jnp.asarray(words.colours)[target[1]]
    known = (kinds == target[0]).any()
    return known & (instruction == kind).any() & (instruction == colour).any()


def false_start(key: jax.Array, window: Window, share: float) -> Window:
    """A window that begins with one to six random moves, and then does what it did.

    The moves lead from another pose, which is found backwards, to the one that the window
    began in. So it shows where a plan has got to that did not begin well, which plans under a
    constraint must know, and demonstrations, being optimal, never show. What follows the moves
    is imitated, they themselves are not: no plan shall begin so of its own.

    Windows stay as they are where the moves are not possible, and where there are past states.

    Args:
        key: chooses.
        window: one training example.
        share: of the windows that begin so.
    """
    if window.context.actions.shape[0]:
        return window
    take_key, start_key = jax.random.split(key)
    most = min(FALSE_MOVES, window.actions.shape[0] - 1)
    if most == 0:
        return window
    count_key, moves_key = jax.random.split(start_key)
    count = jax.random.randint(count_key, (), 1, most + 1)
    later, _, possible = begin_earlier(moves_key, window, count, most, 1 / 2)
    later = later._replace(imitated=jnp.arange(window.actions.shape[0]) >= count)
    taken = possible & jax.random.bernoulli(take_key, share)
    return jax.tree.map(lambda a, b: jnp.where(taken, a, b), later, window)


def detour(key: jax.Array, window: Window, share: float, words: GridWords) -> Window:
    """A window that takes a longer way, in a world where it is the shortest.

    It begins with up to eight random moves; objects and walls are put beside the way, many or
    few; and it is taken where no shorter way is left. So it shows that ways lead around things,
    even where demonstrations are of empty rooms. Of some tries the one is taken whose way is
    longer than it would be without the things, if there is one.

    Windows stay as they are where that does not work out, and where there are past states.

    Args:
        key: chooses.
        window: one training example.
        share: of the windows, in which it is tried.
        words: which word names what.
    """
    if window.context.actions.shape[0]:
        return window
    take_key, tries_key = jax.random.split(key)
    keys = jax.random.split(tries_key, TRIES)
    found, possible, longer = jax.vmap(lambda k: _try_detour(k, window, words))(keys)
    best = jnp.argmax(possible * (1 + longer))
    taken = possible[best] & jax.random.bernoulli(take_key, share)
    return jax.tree.map(lambda a, b: jnp.where(taken, a[best], b), found, window)


def _try_detour(
    key: jax.Array, window: Window, words: GridWords
) -> tuple[Window, jax.Array, jax.Array]:
    """A window on a way, whether it is the shortest, and whether things make it longer."""
    count_key, start_key, share_key, where_key, kind_key, colour_key, wall_key = jax.random.split(
        key, 7
    )
    count = jax.random.randint(count_key, (), 0, DETOUR_MOVES + 1)
    earlier, whole, possible = begin_earlier(start_key, window, count, DETOUR_MOVES, 2 / 3)
    observation, way = earlier.context.observation, earlier.extras
    grid, goal = observation.grid, observation.goal
    cells = grid.shape[:2]
    probability = jax.random.uniform(share_key) ** 0.5  # rather many than few
    filled = (grid[..., 0] == EMPTY) & ~way
    filled &= jax.random.uniform(where_key, cells) < probability
    # Grey walls, and objects that are not meant.
    target = grid[goal[0], goal[1]].astype(jnp.int32)
    in_full = _in_full(observation.instruction, target, words)
    kinds, colours = _other(kind_key, colour_key, target, cells, in_full)
    walls = jax.random.bernoulli(wall_key, shape=cells)
    kinds, colours = jnp.where(walls, WALL, kinds), jnp.where(walls, GREY, colours)
    things = jnp.stack([kinds, colours, jnp.zeros_like(kinds)], axis=-1).astype(grid.dtype)
    filled_grid = jnp.where(filled[..., None], things, grid)

    def moves(grid: jax.Array) -> jax.Array:
        free = passable(grid).at[goal[0], goal[1]].set(True)
        return distance(free, observation.pose[:2], goal)

    # A way without a cell twice has as many cells, but for the goal, as moves lead to the goal.
    length = way.sum()
    first = (whole == FORWARD) & (jnp.arange(len(whole)) < count)
    possible &= length == window.extras.sum() + first.sum()
    possible &= (moves(filled_grid) == length) & (goal[0] >= 0) & ~_wasteful(whole)
    context = earlier.context._replace(observation=observation._replace(grid=filled_grid))
    return earlier._replace(context=context), possible, moves(grid) < length


def distance(free: jax.Array, start: jax.Array, goal: jax.Array) -> jax.Array:
    """Moves from a cell `[2]` to another through free cells `[S, S]`; inf where there is no way."""
    cells = free.shape

    def spread(_: jax.Array, found: jax.Array) -> jax.Array:
        around = jnp.pad(found, 1, constant_values=jnp.inf)
        near = jnp.stack([around[2:, 1:-1], around[:-2, 1:-1], around[1:-1, 2:], around[1:-1, :-2]])
        return jnp.where(free, jnp.minimum(found, near.min(axis=0) + 1), jnp.inf)

    begun = jnp.full(cells, jnp.inf).at[start[0], start[1]].set(0.0)
    found = jax.lax.fori_loop(0, 4 * cells[0], spread, begun)
    return found[goal[0], goal[1]]


def _wasteful(actions: jax.Array) -> jax.Array:
    """Whether turns of a plan `[T]` undo each other, or one would do for three."""
    turning = jnp.where(actions == LEFT, -1, jnp.where(actions == RIGHT, 1, 0))
    undone = (turning[1:] * turning[:-1] == -1).any()
    return undone | (jnp.abs(turning[2:] + turning[1:-1] + turning[:-2]) == 3).any()


def begin_earlier(
    key: jax.Array, window: Window, count: jax.Array, most: int, forward: float
) -> tuple[Window, jax.Array, jax.Array]:
    """A window with random moves before its own, all of its moves, and whether they are possible.

    Ends follow all moves, `[most + horizon]` in all. Moves are not possible where they lead
    through things or lava, past the goal, or out of a doorway: the agent's mark hides its door.

    Args:
        key: chooses the moves.
        window: one training example, without past states.
        count: `[]` how many.
        most: so many at most, and at least one.
        forward: how likely a move is one, and not a turn.
    """
    context, horizon = window.context, window.actions.shape[0]
    turn_key, forward_key = jax.random.split(key)
    shape = (most,)
    turns = jnp.where(jax.random.bernoulli(turn_key, shape=shape), LEFT, RIGHT)
    moves = jnp.where(jax.random.bernoulli(forward_key, forward, shape), FORWARD, turns)
    observation = context.observation
    grid, pose = jnp.asarray(observation.grid), jnp.asarray(observation.pose)
    free = passable(grid) & (grid[..., 0] != LAVA)
    vectors = jnp.asarray(DIRECTION_VECTORS)

    def undo(
        carry: tuple[jax.Array, jax.Array], place: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        """The pose before a move, and whether the move leads from it to the one after."""
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
    # The agent's mark, whose state is its direction, moves to where it begins.
    empty = jnp.array([EMPTY, 0, 0], grid.dtype)
    mark = grid[pose[0], pose[1]].at[2].set(start[2].astype(grid.dtype))
    moved = grid.at[pose[0], pose[1]].set(empty).at[start[0], start[1]].set(mark)
    place = jnp.arange(most + horizon)
    # Its own moves follow, and then what is not known: an end, for it neither turns nor moves.
    own = jnp.append(window.actions, END)[jnp.clip(place - count, 0, horizon)]
    whole = jnp.where(place < count, moves[jnp.minimum(place, most - 1)], own)
    way = window.extras.at[visited[:, 0], visited[:, 1]].set(True)
    began = observation._replace(grid=moved, pose=start)
    longer = window._replace(
        context=context._replace(observation=began), actions=whole[:horizon], extras=way
    )
    return longer, whole, possible


def augment(key: jax.Array, window: Window, words: GridWords, exchange_objects: bool) -> Window:
    """A window as it could have been: mirrored, recoloured, with other objects, in other words.

    Each is a symmetry of the levels, so the result is just as good a demonstration.

    Args:
        key: chooses.
        window: one training example.
        words: which word names what.
        exchange_objects: whether key, ball and box are alike, which they are in
            demonstrations that unlock no door and toggle no box.
    """
    # Here and not before: a program says how many devices it has after a domain is made.
    words = jax.tree.map(jnp.asarray, words)
    flip_key, colour_key, object_key, restate_key = jax.random.split(key, 4)
    colours = jax.random.permutation(colour_key, len(words.colours))
    objects = jnp.arange(symmetries.AGENT + 1)
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    vocabulary = jnp.arange(words.mirrored.shape[0])
    vocabulary = vocabulary.at[words.colours].set(words.colours[colours])
    if exchange_objects:
        order = jax.random.permutation(object_key, len(kinds))
        objects = objects.at[kinds].set(kinds[order])
        vocabulary = vocabulary.at[words.objects].set(words.objects[order])
    renaming = symmetries.Renaming(colours, objects, vocabulary)
    renamed = _throughout(window, lambda observation: symmetries.rename(observation, renaming))
    restated = _either(restate_key, restate(renamed, words), renamed)
    return _either(flip_key, reflect(restated, words.mirrored), restated)


def _throughout(window: Window, change: Callable[[Observation], Observation]) -> Window:
    """A window with every state changed, the past ones too."""
    context = window.context
    return window._replace(
        context=context._replace(
            observation=change(context.observation), past=jax.vmap(change)(context.past)
        )
    )


def _either(key: jax.Array, first: Window, second: Window) -> Window:
    """One of two windows, with equal chances."""
    take = jax.random.bernoulli(key)
    return jax.tree.map(lambda a, b: jnp.where(take, a, b), first, second)


def restate(window: Window, words: GridWords) -> Window:
    """The same window, told with the other of ", then" and "after you"."""

    def say(observation: Observation) -> Observation:
        said = symmetries.restate(observation.instruction, words.then, words.after)
        return observation._replace(instruction=said)

    return _throughout(window, say)


def reflect(window: Window, mirrored_words: jax.Array) -> Window:
    """The mirror image of one window."""
    context = window.context
    past = jax.vmap(lambda o: symmetries.reflect(o, mirrored_words))(context.past)
    # Blank states before the start have no mirror image. (How many they are does not follow from
    # the step: an unrolled window's past goes on beyond it.)
    length = context.actions.shape[0]
    known = (jnp.asarray(context.past.grid) != 0).any(axis=(1, 2, 3))

    def keep_blank(mirrored: jax.Array, original: jax.Array) -> jax.Array:
        return jnp.where(known.reshape(length, *(1,) * (mirrored.ndim - 1)), mirrored, original)

    return window._replace(
        context=context._replace(
            observation=symmetries.reflect(context.observation, mirrored_words),
            past=jax.tree.map(keep_blank, past, context.past),
            actions=symmetries.reflect_actions(context.actions),
        ),
        actions=symmetries.reflect_actions(window.actions),
        extras=window.extras[:, ::-1],
    )
