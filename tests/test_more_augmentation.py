"""The augmentation that models of `experiments.properties` are trained with."""

import dataclasses
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minigrid.core.grid import Grid

from experiments import augmentation
from experiments.augmentation import Settings, add_detour, add_false_start, add_lookalikes
from leapjax.data import windows
from leapjax.domains.babyai import demonstrations, levels, vocabulary
from leapjax.domains.babyai.adapter import END
from leapjax.domains.babyai.augmentation import choose_augmentations, mark_needed_cells
from leapjax.domains.babyai.augmentation.words import find_words
from leapjax.domains.babyai.dynamics import FORWARD, LAVA, roll
from tests.dynamics import FRONT, stepped
from tests.oracles import slow_path_lengths
from tests.programs import only_long

WORDS = find_words()
window_at = jax.jit(windows.window, static_argnums=(2, 3, 4))


def plain_windows(horizon=10, level="GoToLocalS8N1", episodes=6):
    """Windows of an empty room, or of another level, from every step."""
    data = demonstrations.collect(levels.find_level(level), episodes, seed=1).demonstrations
    steps = windows.concatenate(data, mark_needed_cells)
    steps = jax.tree.map(jnp.asarray, steps)
    return [window_at(steps, i, 0, horizon, END) for i in range(steps.actions.shape[0])]


def changed_by(augmentation_of, windows_of, keys=12):
    """Pairs of windows that an augmentation changed: before and after."""
    for number, window in enumerate(windows_of):
        for key in range(keys):
            after = jax.device_get(augmentation_of(jax.random.key(100 * number + key), window))
            if not np.array_equal(after.context.observation.grid, window.context.observation.grid):
                yield jax.device_get(window), after


def test_a_false_start_leads_to_where_the_window_began():
    change = jax.jit(lambda key, window: add_false_start(key, window, 1.0))
    lengths = Counter()
    for before, after in changed_by(change, plain_windows()):
        state = after.context.observation
        began = before.context.observation.grid
        moves = int(after.imitated.argmax())
        assert after.imitated[moves:].all() and not after.imitated[:moves].any()
        np.testing.assert_array_equal(after.actions[moves:], before.actions[: 10 - moves])
        np.testing.assert_array_equal(walked(state, after.actions[:moves]).grid, began)
        lengths[moves] += 1
        assert after.extras[tuple(state.pose[:2])]
    assert set(lengths) == set(range(1, 7))


@pytest.mark.parametrize("name", ["false_starts", pytest.param("detours", marks=only_long)])
def test_what_begins_earlier_never_steps_on_lava(name):
    """Demonstrations walk around it: what is added to them must too."""
    [change] = map(jax.jit, augmentation.choose(Settings(**{name: 1.0})))
    walk = jax.jit(roll)  # compiled once, not for each window
    lava = changed = 0
    for _, after in changed_by(change, plain_windows(10, "GoToLavaMedium", 20)):
        state, changed = after.context.observation, changed + 1
        lava += (state.grid[..., 0] == LAVA).any()
        cells = walk(state, jnp.asarray(after.actions))[:, :2]
        assert (state.grid[cells[:, 0], cells[:, 1], 0] != LAVA).all()
    assert lava > 50 and changed > 50


def walked(state, actions):
    for action in actions:
        state = stepped(state, int(action))
    return state


def test_a_detour_is_the_shortest_way_and_still_leads_to_the_goal():
    change = jax.jit(lambda key, window: add_detour(key, window, 1.0, WORDS))
    longer = things = 0
    for before, after in changed_by(change, plain_windows(horizon=24)):
        assert after.imitated.all()
        state = after.context.observation
        goal = tuple(map(int, state.goal))
        end = walked(state, after.actions[after.actions != END])
        x, y, direction = map(int, end.pose)
        assert (x + FRONT[direction][0], y + FRONT[direction][1]) == goal
        grid, _ = Grid.decode(np.asarray(state.grid))
        start = tuple(map(int, state.pose[:2]))
        moves = int((after.actions == 2).sum())
        assert moves + 1 == after.extras.sum()  # no cell twice, and not the goal
        assert slow_path_lengths(grid, start, through_objects=False)[goal] == moves + 1
        straight = abs(start[0] - goal[0]) + abs(start[1] - goal[1])
        longer += moves + 1 > straight
        things += int((state.grid[..., 0] != before.context.observation.grid[..., 0]).sum() > 4)
    assert longer > 10 and things > 10


def test_short_windows_get_detours_as_often_where_they_turn_as_where_they_move():
    change = jax.jit(lambda key, window: add_detour(key, window, 1.0, WORDS))
    short, keys = plain_windows(horizon=1), 12
    found = Counter(
        int(before.actions[0]) == FORWARD for before, _ in changed_by(change, short, keys)
    )
    tried = Counter(int(window.actions[0]) == FORWARD for window in short)
    turning, moving = (found[moves] / tried[moves] / keys for moves in (False, True))
    assert turning > 0.8 * moving > 0.5


@pytest.mark.parametrize("named", [True, False])
def test_lookalikes_share_kind_or_colour_with_a_target_that_is_named_but_never_both(named):
    fill = jax.jit(lambda key, window: add_lookalikes(key, window, 1.0, WORDS))

    def unnamed(window):
        said = jnp.asarray(vocabulary.encode("go to the box", 5))
        seen = window.context.observation._replace(instruction=said)
        return window._replace(context=window.context._replace(observation=seen))

    found = plain_windows()[:4]
    shared = np.zeros(2, int)
    for before, after in changed_by(fill, found if named else map(unnamed, found)):
        grid, goal = after.context.observation.grid, tuple(before.context.observation.goal)
        new = (grid != before.context.observation.grid).any(axis=-1)
        same = grid[new][:, :2] == grid[goal][:2]
        assert not same.all(axis=1).any()
        shared += same.sum(axis=0)
    assert (shared > 0).all() == shared.any() == named


def test_what_is_added_stands_between_the_symmetries_and_the_clutter_of_babyai():
    plain = Settings(augment=True, clutter=0.4)
    more = augmentation.choose(dataclasses.replace(plain, false_starts=0.5, detours=0.5))
    window, key = plain_windows()[0], jax.random.key(3)
    assert len(more) == 4 and augmentation.choose(Settings()) == []
    for others in (augmentation.choose(plain), [more[0], more[3]]):
        for change, other in zip(choose_augmentations(plain), others, strict=True):
            pairs = (jax.tree.leaves(each(key, window)) for each in (change, other))
            assert all(map(np.array_equal, *pairs))
