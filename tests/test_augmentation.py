import functools
from collections import Counter
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX
from minigrid.core.grid import Grid

from leapjax.data import windows
from leapjax.domains.babyai import augmentation, demonstrations, levels, vocabulary
from leapjax.domains.babyai.adapter import END
from leapjax.domains.babyai.augmentation.words import GridWords
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from tests.dynamics import FRONT, stepped
from tests.oracles import slow_path_lengths

EMPTY, KEY, BALL, BOX = 1, 5, 6, 7
GRID_WORDS = GridWords(
    jnp.asarray(vocabulary.colour_words()),
    jnp.asarray(vocabulary.object_words((KEY, BALL, BOX))),
    jnp.asarray(vocabulary.mirrored_words()),
    *map(jnp.asarray, vocabulary.joining_words()),
)

augment = jax.jit(augmentation.apply_symmetries, static_argnums=3)
clutter = jax.jit(augmentation.add_clutter)
window_at = jax.jit(windows.window, static_argnums=(2, 3, 4))
unrolled_at = jax.jit(windows.unrolled_window, static_argnums=(2, 3, 4))
transition_at = jax.jit(windows.transition_window, static_argnums=(2, 3))
lay_out = functools.partial(windows.concatenate, extras=augmentation.mark_needed_cells)


@functools.cache
def whole_windows(name: str, context: int, horizon: int) -> list[windows.Window]:
    """The window at the start of each of some demonstrations."""
    level = levels.find_level(name)
    collected = demonstrations.collect(level, 6, seed=1).demonstrations
    steps = lay_out([d for d in collected if len(d.actions) < horizon])
    steps = jax.tree.map(jnp.asarray, steps)
    return [window_at(steps, i, context, horizon, END) for i in steps.starts]


@pytest.mark.parametrize(
    ("name", "exchange_objects"),
    [("GoToLocalS8N7", True), ("GoToObjMazeS4R2Close", False), ("PickUpLoc", True)],
)
def test_an_augmented_demonstration_still_does_what_it_is_told(name, exchange_objects):
    seen = set()
    for number, window in enumerate(whole_windows(name, 0, 32)):
        for key in range(4):
            fold = jax.random.key(10 * number + key)
            changed = jax.device_get(augment(fold, window, GRID_WORDS, exchange_objects))
            state = changed.context.observation
            for action in changed.actions[changed.actions != END]:
                previous, state = state, stepped(state, int(action))
            x, y, direction = (int(v) for v in state.pose)
            dx, dy = FRONT[direction]
            assert (x + dx, y + dy) == tuple(state.goal)
            words = vocabulary.decode(state.instruction).split()
            if name == "PickUpLoc":
                assert not previous.carried.any()
                kind, colour = state.carried
            else:
                kind, colour, _ = state.grid[tuple(state.goal)]
            kinds = {w: OBJECT_TO_IDX[w] for w in ("key", "ball", "box", "door") if w in words}
            colours = {w: COLOR_TO_IDX[w] for w in COLOR_TO_IDX if w in words}
            assert not kinds or list(kinds.values()) == [kind]
            assert not colours or list(colours.values()) == [colour]
            assert_place_holds(changed.context.observation, words)
            seen.add((kind, colour, changed.actions.tobytes()))
    assert len(seen) > 8  # and they were changed


def assert_place_holds(state: Observation, words: list[str]) -> None:
    """The goal is on the side that the instruction names."""
    offset = np.asarray(state.goal) - state.pose[:2]
    ahead = np.array(FRONT[state.pose[2]])
    right = np.array([-ahead[1], ahead[0]])
    sides = {"front": ahead, "behind": -ahead, "left": -right, "right": right}
    for word, side in sides.items():
        assert word not in words or offset @ side > 0


def test_augmentation_covers_the_symmetries_and_depends_on_its_key():
    window = whole_windows("GoToLocalS8N7", 0, 32)[0]
    state = window.context.observation
    (x, y), side = (int(v) for v in state.goal), state.grid.shape[0]

    def draw(key: int, exchange_objects: bool) -> tuple[int, int, int]:
        """The target's row, kind and colour."""
        changed = augment(jax.random.key(key), window, GRID_WORDS, exchange_objects)
        row = int(changed.context.observation.goal[1])
        kind, colour, _ = np.asarray(changed.context.observation.grid)[x, row].tolist()
        return row, kind, colour

    draws = [draw(key, True) for key in range(200)]
    assert draws[:20] == [draw(key, True) for key in range(20)]
    rows, kinds, colours = (Counter(column) for column in zip(*draws, strict=True))
    assert rows.keys() == {y, side - 1 - y} and min(rows.values()) > 60
    assert kinds.keys() == {KEY, BALL, BOX} and min(kinds.values()) > 40
    assert len(colours) == 6 and min(colours.values()) > 15
    assert {draw(key, False)[1] for key in range(20)} == {int(state.grid[x, y, 0])}


@pytest.mark.parametrize("name", ["GoToObjMazeS4R2Close", "GoToSeqS5R2"])
def test_the_past_is_transformed_with_the_present(name):
    context = 3
    level = levels.find_level(name)
    [demonstration] = [
        d for d in demonstrations.collect(level, 6, seed=1).demonstrations if len(d.actions) > 5
    ][:1]
    steps = jax.tree.map(jnp.asarray, lay_out([demonstration]))
    blank = window_at(steps, jnp.int32(0), context, 2, END)
    changed = augment(jax.random.key(0), blank, GRID_WORDS, True)
    assert not any(leaf.any() for leaf in jax.tree.leaves(changed.context.past))
    window = window_at(steps, jnp.int32(4), context, 2, END)
    for key in range(6):
        changed = jax.device_get(augment(jax.random.key(key), window, GRID_WORDS, True))
        past = [jax.tree.map(lambda x, i=i: x[i], changed.context.past) for i in range(context)]
        assert_lead_on([*past, changed.context.observation], changed.context.actions)


def assert_lead_on(moments: list[Observation], actions: np.ndarray) -> None:
    """Each action leads from one state to the next, of one world with one instruction."""
    for (before, after), action in zip(pairwise(moments), actions, strict=True):
        np.testing.assert_array_equal(stepped(before, int(action)).pose, after.pose)
        np.testing.assert_array_equal(before.instruction, after.instruction)
        np.testing.assert_array_equal(before.goal, after.goal)


@pytest.mark.parametrize(("name", "place"), [("GoToLocalS7N5", 0), ("GoToObjMazeS4", 2)])
def test_the_future_of_an_unrolled_window_is_transformed_with_its_past(name, place):
    """From the first step on, when more states are known than steps were made."""
    level, horizon = levels.find_level(name), 4
    collected = demonstrations.collect(level, 20, seed=1).demonstrations
    [demonstration] = [d for d in collected if len(d.actions) > place + horizon][:1]
    steps = jax.tree.map(jnp.asarray, lay_out([demonstration]))
    window = unrolled_at(steps, jnp.int32(place), 0, horizon, END)
    mirrored = Counter()
    for key in range(8):
        changed = jax.device_get(augment(jax.random.key(key), window, GRID_WORDS, True))
        past = [jax.tree.map(lambda x, i=i: x[i], changed.context.past) for i in range(horizon - 1)]
        assert_lead_on([*past, changed.context.observation], changed.actions[:-1])
        mirrored[bool((past[0].pose != window.context.past.pose[0]).any())] += 1
    assert min(mirrored[False], mirrored[True]) > 0


def added(before: Observation, after: Observation) -> np.ndarray:
    """`[S, S]` bool: where a window holds an object that it did not hold."""
    return (np.asarray(before.grid) != np.asarray(after.grid)).any(axis=-1)


def shortest(state: Observation) -> int:
    """Moves until the goal is touched."""
    grid, _ = Grid.decode(np.asarray(state.grid))
    x, y, goal_x, goal_y = (int(v) for v in (*state.pose[:2], *state.goal))
    grid.set(x, y, None)  # the agent is not in its own way
    return slow_path_lengths(grid, (x, y))[goal_x, goal_y]


@pytest.mark.parametrize("name", ["GoToObjMazeS4", "PickUpLoc"])
def test_in_clutter_a_demonstration_stays_possible_and_shortest(name):
    filled = 0
    for number, window in enumerate(whole_windows(name, 0, 32)):
        before = jax.device_get(window.context.observation)
        target = before.grid[tuple(before.goal)]
        plain = before
        for action in window.actions[window.actions != END]:
            plain = stepped(plain, int(action))
        for key in range(4):
            fold = jax.random.key(10 * number + key)
            changed = jax.device_get(clutter(fold, window, 1.0))
            state = start = changed.context.observation
            where = added(before, state)
            new = state.grid[where]
            assert np.isin(new[:, 0], (KEY, BALL, BOX)).all() and (new[:, 1] < 6).all()
            # No instruction can mean them.
            assert (new[:, 0] != target[0]).all() and (new[:, 1] != target[1]).all()
            for action in window.actions[window.actions != END]:
                state = stepped(state, int(action))
            np.testing.assert_array_equal(state.pose, plain.pose)
            np.testing.assert_array_equal(state.carried, plain.carried)
            assert shortest(start) == shortest(before)
            filled += int(where.sum())
    assert filled > 100


def test_clutter_is_unlike_a_target_that_is_picked_up_meanwhile():
    """In the last transition of a demonstration the target's cell is empty afterwards."""
    collected = demonstrations.collect(levels.find_level("PickUpLoc"), 12, seed=1).demonstrations
    steps = jax.tree.map(jnp.asarray, lay_out(collected))
    seen = 0
    for last in np.asarray(steps.starts + steps.lengths - 1):
        window = transition_at(steps, last, 0, END)
        before = jax.tree.map(lambda x: x[-1], window.context.past)
        kind, colour, _ = np.asarray(before.grid)[tuple(before.goal)]
        assert np.asarray(window.context.observation.grid)[tuple(before.goal)][0] == EMPTY
        for key in range(4):
            changed = clutter(jax.random.key(key), window, 1.0)
            new = np.asarray(changed.context.past.grid[-1])[
                added(before, jax.tree.map(lambda x: x[-1], changed.context.past))
            ]
            assert (new[:, 0] != kind).all() and (new[:, 1] != colour).all()
            seen += len(new)
    assert seen > 100


def test_clutter_leaves_half_of_the_windows_and_fills_up_to_its_share():
    window = whole_windows("GoToLocalS8N7", 0, 32)[0]
    before = jax.device_get(window.context.observation)
    free = (before.grid[..., 0] == EMPTY) & ~np.asarray(window.extras)
    keys = jax.random.split(jax.random.key(0), 400)
    many = jax.vmap(lambda k, share: clutter(k, window, share), in_axes=(0, None))
    grids = np.asarray(many(keys, 0.5).context.observation.grid)
    shares = (grids != before.grid).any(axis=-1)[:, free].mean(axis=1)
    assert 160 < (shares > 0).sum() < 230  # few objects may be none
    assert shares[shares > 0].mean() == pytest.approx(0.25, abs=0.04)
    assert (grids == before.grid)[:, ~free].all()
    assert (np.asarray(many(keys, 0.0).context.observation.grid) == before.grid).all()


def test_what_a_demonstration_puts_down_keeps_its_place():
    level = levels.find_level("BabyAI-PutNextLocal-v0")
    collected = demonstrations.collect(level, 4, seed=1).demonstrations
    dropped = 0
    for demonstration in collected:
        steps = lay_out([demonstration])
        for start in range(0, len(demonstration.actions), 3):
            state = jax.tree.map(lambda leaf, i=start: leaf[i], demonstration.observations)
            free = (state.grid[..., 0] == EMPTY) & ~steps.extras[start]
            state.grid[free] = (BALL, 0, 0)
            for index, action in enumerate(demonstration.actions[start:], start + 1):
                state = stepped(state, int(action))
                np.testing.assert_array_equal(state.pose, demonstration.observations.pose[index])
                np.testing.assert_array_equal(
                    state.carried, demonstration.observations.carried[index]
                )
                dropped += action == 4
    assert dropped


def test_clutter_was_always_there_and_needs_a_goal():
    level = levels.find_level("GoToObjMazeS4R2Close")
    demonstration = max(
        demonstrations.collect(level, 6, seed=1).demonstrations, key=lambda d: len(d.actions)
    )
    steps = jax.tree.map(jnp.asarray, lay_out([demonstration]))
    seen = 0
    for context, start in ((3, 4), (3, 1)):
        window = window_at(steps, jnp.int32(start), context, 2, END)
        for key in range(6):
            changed = jax.device_get(clutter(jax.random.key(key), window, 1.0))
            where = added(window.context.observation, changed.context.observation)
            seen += int(where.sum())
            for moment in range(context):
                before, after = window.context.past.grid[moment], changed.context.past.grid[moment]
                if moment < context - start:
                    np.testing.assert_array_equal(after, np.zeros_like(after))
                    continue
                np.testing.assert_array_equal((before != after).any(axis=-1), where)
                now = changed.context.observation.grid
                np.testing.assert_array_equal(after[where], now[where])
        aimless = window._replace(
            context=window.context._replace(
                observation=window.context.observation._replace(goal=jnp.array([-1, -1]))
            )
        )
        jax.tree.map(
            np.testing.assert_array_equal, clutter(jax.random.key(1), aimless, 1.0), aimless
        )
    assert seen > 20


def test_half_of_the_sequences_are_said_the_other_way_round_and_settings_choose():
    window = next(
        window
        for window in whole_windows("GoToSeqS5R2", 0, 200)
        if ", then" in vocabulary.decode(window.context.observation.instruction)
    )
    said = Counter(
        "after you" in vocabulary.decode(changed.context.observation.instruction)
        for changed in (augment(jax.random.key(k), window, GRID_WORDS, True) for k in range(100))
    )
    assert min(said[False], said[True]) > 30
    assert augmentation.choose_augmentations(Settings()) == []
    assert len(augmentation.choose_augmentations(Settings(augment=True, clutter=1.0))) == 2
