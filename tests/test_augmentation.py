"""Augmentations of BabyAI's windows, and those that `experiments.properties` adds to them."""

import dataclasses
import functools
from collections import Counter
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX
from minigrid.core.grid import Grid

from experiments import augmentation as more
from leapjax.data import windows
from leapjax.domains.babyai import augmentation, demonstrations, levels, vocabulary
from leapjax.domains.babyai.adapter import END
from leapjax.domains.babyai.augmentation.words import find_words
from leapjax.domains.babyai.dynamics import FORWARD, LAVA, roll
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.settings import Settings
from tests.dynamics import FRONT, stepped
from tests.oracles import slow_path_lengths
from tests.programs import only_long

EMPTY, KEY, BALL, BOX = 1, 5, 6, 7
WORDS = find_words()

augment = jax.jit(augmentation.apply_symmetries, static_argnums=3)
clutter = jax.jit(augmentation.add_clutter)
window_at = jax.jit(windows.window, static_argnums=(2, 3, 4))


@functools.cache
def collected(name: str, episodes: int = 6) -> list:
    return demonstrations.collect(levels.find_level(name), episodes, seed=1).demonstrations


def lay_out(some) -> windows.Steps:
    return jax.tree.map(jnp.asarray, windows.concatenate(some, augmentation.mark_needed_cells))


@functools.cache
def whole_windows(name: str, horizon: int = 32) -> list[windows.Window]:
    """The window at the start of each of some demonstrations."""
    steps = lay_out([d for d in collected(name) if len(d.actions) < horizon])
    return [window_at(steps, i, 0, horizon, END) for i in steps.starts]


def walked(state: Observation, actions) -> Observation:
    """The state after the actions before the end action."""
    for action in np.asarray(actions)[np.asarray(actions) != END]:
        state = stepped(state, int(action))
    return state


def draw(change, window, *rest, keys=4, first=0):
    """What an augmentation makes of a window with some keys, on the host."""
    for key in range(first, first + keys):
        yield jax.device_get(change(jax.random.key(key), window, *rest))


def moment(states: Observation, index: int) -> Observation:
    return jax.tree.map(lambda x: np.asarray(x[index]), states)


@pytest.mark.parametrize(
    ("name", "exchange_objects"),
    [("GoToLocalS8N7", True), ("GoToObjMazeS4R2Close", False), ("PickUpLoc", True)],
)
def test_an_augmented_demonstration_still_does_what_it_is_told(name, exchange_objects):
    seen = set()
    for number, window in enumerate(whole_windows(name)):
        for changed in draw(augment, window, WORDS, exchange_objects, first=10 * number):
            begin = changed.context.observation
            state = walked(begin, changed.actions)
            x, y, direction = (int(v) for v in state.pose)
            assert (x + FRONT[direction][0], y + FRONT[direction][1]) == tuple(state.goal)
            words = vocabulary.decode(state.instruction).split()
            kind, colour = state.grid[tuple(state.goal)][:2]
            if name == "PickUpLoc":
                assert not begin.carried.any()
                kind, colour = state.carried
            kinds = [OBJECT_TO_IDX[w] for w in ("key", "ball", "box", "door") if w in words]
            colours = [COLOR_TO_IDX[w] for w in COLOR_TO_IDX if w in words]
            assert kinds in ([], [kind]) and colours in ([], [colour])
            # The goal is on the side that the instruction names.
            offset = np.asarray(begin.goal) - begin.pose[:2]
            ahead = np.array(FRONT[begin.pose[2]])
            right = np.array([-ahead[1], ahead[0]])
            sides = {"front": ahead, "behind": -ahead, "left": -right, "right": right}
            assert all(offset @ side > 0 for word, side in sides.items() if word in words)
            seen.add((kind, colour, changed.actions.tobytes()))
    assert len(seen) > 8  # and they were changed


def test_augmentation_covers_the_symmetries_and_depends_on_its_key():
    window = whole_windows("GoToLocalS8N7")[0]
    state = window.context.observation
    (x, y), side = (int(v) for v in state.goal), state.grid.shape[0]

    def targets(keys: int, exchange_objects: bool) -> list[tuple[int, int, int]]:
        """The targets' rows, kinds and colours."""
        seen = [
            c.context.observation for c in draw(augment, window, WORDS, exchange_objects, keys=keys)
        ]
        return [(int(o.goal[1]), *o.grid[x, o.goal[1]][:2].tolist()) for o in seen]

    draws = targets(200, True)
    assert draws[:20] == targets(20, True)
    rows, kinds, colours = (Counter(column) for column in zip(*draws, strict=True))
    assert rows.keys() == {y, side - 1 - y} and min(rows.values()) > 60
    assert kinds.keys() == {KEY, BALL, BOX} and min(kinds.values()) > 40
    assert len(colours) == 6 and min(colours.values()) > 15
    assert {kind for _, kind, _ in targets(20, False)} == {int(state.grid[x, y, 0])}


@pytest.mark.parametrize("name", ["GoToObjMazeS4R2Close", "GoToSeqS5R2"])
def test_the_past_is_transformed_with_the_present(name):
    steps = lay_out([next(d for d in collected(name) if len(d.actions) > 5)])
    (blank,) = draw(augment, window_at(steps, 0, 3, 2, END), WORDS, True, keys=1)
    assert not any(leaf.any() for leaf in jax.tree.leaves(blank.context.past))
    for changed in draw(augment, window_at(steps, 4, 3, 2, END), WORDS, True, keys=6):
        past = [moment(changed.context.past, i) for i in range(3)]
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
    horizon = 4
    steps = lay_out([next(d for d in collected(name, 20) if len(d.actions) > place + horizon)])
    window = windows.unrolled_window(steps, jnp.int32(place), 0, horizon, END)
    mirrored = set()
    for changed in draw(augment, window, WORDS, True, keys=8):
        past = [moment(changed.context.past, i) for i in range(horizon - 1)]
        assert_lead_on([*past, changed.context.observation], changed.actions[:-1])
        mirrored.add(bool((past[0].pose != window.context.past.pose[0]).any()))
    assert mirrored == {False, True}


def added(before: Observation, after: Observation) -> np.ndarray:
    """`[S, S]` bool: where a window holds an object that it did not hold."""
    return (np.asarray(before.grid) != np.asarray(after.grid)).any(axis=-1)


def shortest(state: Observation) -> int:
    """Moves until the goal is touched."""
    grid, _ = Grid.decode(np.asarray(state.grid))
    grid.set(*map(int, state.pose[:2]), None)  # the agent is not in its own way
    return slow_path_lengths(grid, tuple(map(int, state.pose[:2])))[tuple(map(int, state.goal))]


@pytest.mark.parametrize("name", ["GoToObjMazeS4", "PickUpLoc"])
def test_in_clutter_a_demonstration_stays_possible_and_shortest(name):
    filled = 0
    for number, window in enumerate(whole_windows(name)):
        before = jax.device_get(window.context.observation)
        target, plain = before.grid[tuple(before.goal)], walked(before, window.actions)
        for changed in draw(clutter, window, 1.0, first=10 * number):
            start = changed.context.observation
            where = added(before, start)
            new = start.grid[where]
            assert np.isin(new[:, 0], (KEY, BALL, BOX)).all() and (new[:, 1] < 6).all()
            # No instruction can mean them.
            assert (new[:, 0] != target[0]).all() and (new[:, 1] != target[1]).all()
            state = walked(start, window.actions)
            np.testing.assert_array_equal(state.pose, plain.pose)
            np.testing.assert_array_equal(state.carried, plain.carried)
            assert shortest(start) == shortest(before)
            filled += int(where.sum())
    assert filled > 100


def test_clutter_is_unlike_a_target_that_is_picked_up_meanwhile():
    """In the last transition of a demonstration the target's cell is empty afterwards."""
    steps, seen = lay_out(collected("PickUpLoc")), 0
    for last in np.asarray(steps.starts + steps.lengths - 1):
        window = windows.transition_window(steps, last, 0, END)
        before = moment(window.context.past, -1)
        kind, colour, _ = before.grid[tuple(before.goal)]
        assert np.asarray(window.context.observation.grid)[tuple(before.goal)][0] == EMPTY
        for changed in draw(clutter, window, 1.0):
            after = moment(changed.context.past, -1)
            new = after.grid[added(before, after)]
            assert (new[:, 0] != kind).all() and (new[:, 1] != colour).all()
            seen += len(new)
    assert seen > 50


def test_clutter_leaves_half_of_the_windows_and_fills_up_to_its_share():
    window = whole_windows("GoToLocalS8N7")[0]
    before = np.asarray(window.context.observation.grid)
    free = (before[..., 0] == EMPTY) & ~np.asarray(window.extras)
    keys = jax.random.split(jax.random.key(0), 400)
    many = jax.vmap(lambda k, share: clutter(k, window, share), in_axes=(0, None))
    grids = np.asarray(many(keys, 0.5).context.observation.grid)
    shares = (grids != before).any(axis=-1)[:, free].mean(axis=1)
    assert 160 < (shares > 0).sum() < 230  # few objects may be none
    assert shares[shares > 0].mean() == pytest.approx(0.25, abs=0.04)
    assert (grids == before)[:, ~free].all()
    assert (np.asarray(many(keys, 0.0).context.observation.grid) == before).all()


def test_what_a_demonstration_puts_down_keeps_its_place():
    dropped = 0
    for demonstration in collected("BabyAI-PutNextLocal-v0")[:4]:
        needed = np.asarray(lay_out([demonstration]).extras)
        for start in range(0, len(demonstration.actions), 3):
            state = moment(demonstration.observations, start)
            state.grid[(state.grid[..., 0] == EMPTY) & ~needed[start]] = (BALL, 0, 0)
            for index, action in enumerate(demonstration.actions[start:], start + 1):
                state, expected = (
                    stepped(state, int(action)),
                    moment(demonstration.observations, index),
                )
                np.testing.assert_array_equal(state.pose, expected.pose)
                np.testing.assert_array_equal(state.carried, expected.carried)
                dropped += action == 4
    assert dropped


def test_clutter_was_always_there_and_needs_a_goal():
    steps = lay_out([max(collected("GoToObjMazeS4R2Close"), key=lambda d: len(d.actions))])
    seen = 0
    for start in (4, 1):
        window = window_at(steps, start, 3, 2, END)
        for changed in draw(clutter, window, 1.0, keys=6):
            now = changed.context.observation.grid
            where = added(window.context.observation, changed.context.observation)
            seen += int(where.sum())
            for index in range(3):
                before, after = (moment(w.context.past, index) for w in (window, changed))
                if index < 3 - start:
                    assert not after.grid.any()
                    continue
                np.testing.assert_array_equal(added(before, after), where)
                np.testing.assert_array_equal(after.grid[where], now[where])
    assert seen > 20
    seen = window.context.observation._replace(goal=jnp.array([-1, -1]))
    aimless = window._replace(context=window.context._replace(observation=seen))
    for changed in draw(clutter, aimless, 1.0):
        jax.tree.map(np.testing.assert_array_equal, changed, aimless)


def test_half_of_the_sequences_are_said_the_other_way_round_and_settings_choose():
    def said(window):
        return vocabulary.decode(np.asarray(window.context.observation.instruction))

    window = next(w for w in whole_windows("GoToSeqS5R2", 200) if ", then" in said(w))
    found = Counter("after you" in said(w) for w in draw(augment, window, WORDS, True, keys=100))
    assert min(found[False], found[True]) > 30
    assert augmentation.choose_augmentations(Settings()) == []
    assert len(augmentation.choose_augmentations(Settings(augment=True, clutter=1.0))) == 2


def plain_windows(horizon=10, level="GoToLocalS8N1", episodes=6):
    """Windows of an empty room, or of another level, from every step."""
    steps = lay_out(collected(level, episodes))
    return [window_at(steps, i, 0, horizon, END) for i in range(steps.actions.shape[0])]


def changed_by(change, some, keys=12):
    """Pairs of windows that an augmentation changed: before and after."""
    for number, window in enumerate(some):
        for after in draw(change, window, keys=keys, first=100 * number):
            if added(window.context.observation, after.context.observation).any():
                yield jax.device_get(window), after


def test_a_false_start_leads_to_where_the_window_began():
    change = jax.jit(lambda key, window: more.add_false_start(key, window, 1.0))
    lengths = set()
    for before, after in changed_by(change, plain_windows()):
        state, moves = after.context.observation, int(after.imitated.argmax())
        assert after.imitated[moves:].all() and not after.imitated[:moves].any()
        np.testing.assert_array_equal(after.actions[moves:], before.actions[: 10 - moves])
        began = walked(state, after.actions[:moves]).grid
        np.testing.assert_array_equal(began, before.context.observation.grid)
        assert after.extras[tuple(state.pose[:2])]
        lengths.add(moves)
    assert lengths == set(range(1, 7))


@pytest.mark.parametrize("name", ["false_starts", pytest.param("detours", marks=only_long)])
def test_what_begins_earlier_never_steps_on_lava(name):
    """Demonstrations walk around it: what is added to them must too."""
    [change] = map(jax.jit, more.choose(more.Settings(**{name: 1.0})))
    walk = jax.jit(roll)  # compiled once, not for each window
    lava = changed = 0
    for _, after in changed_by(change, plain_windows(10, "GoToLavaMedium", 20)):
        state, changed = after.context.observation, changed + 1
        lava += (state.grid[..., 0] == LAVA).any()
        cells = walk(state, jnp.asarray(after.actions))[:, :2]
        assert (state.grid[cells[:, 0], cells[:, 1], 0] != LAVA).all()
    assert lava > 50 and changed > 50


def test_a_detour_is_the_shortest_way_and_still_leads_to_the_goal():
    change = jax.jit(lambda key, window: more.add_detour(key, window, 1.0, WORDS))
    longer = things = 0
    for before, after in changed_by(change, plain_windows(horizon=24)):
        assert after.imitated.all()
        state = after.context.observation
        x, y, direction = map(int, walked(state, after.actions).pose)
        assert (x + FRONT[direction][0], y + FRONT[direction][1]) == tuple(state.goal)
        moves = int((after.actions == FORWARD).sum())
        assert shortest(state) == moves + 1 == after.extras.sum()  # no cell twice, not the goal
        longer += moves + 1 > np.abs(state.pose[:2] - state.goal).sum()
        things += added(before.context.observation, state).sum() > 6
    assert longer > 10 and things > 10


def test_short_windows_get_detours_as_often_where_they_turn_as_where_they_move():
    change = jax.jit(lambda key, window: more.add_detour(key, window, 1.0, WORDS))
    short, keys = plain_windows(horizon=1), 12
    found = Counter(int(before.actions[0]) == FORWARD for before, _ in changed_by(change, short))
    tried = Counter(int(window.actions[0]) == FORWARD for window in short)
    turning, moving = (found[moves] / tried[moves] / keys for moves in (False, True))
    assert turning > 0.8 * moving > 0.5


@pytest.mark.parametrize("named", [True, False])
def test_lookalikes_share_kind_or_colour_with_a_target_that_is_named_but_never_both(named):
    fill = jax.jit(lambda key, window: more.add_lookalikes(key, window, 1.0, WORDS))

    def unname(window):
        said = jnp.asarray(vocabulary.encode("go to the box", 5))
        seen = window.context.observation._replace(instruction=said)
        return window._replace(context=window.context._replace(observation=seen))

    found, shared = plain_windows()[:4], np.zeros(2, int)
    for before, after in changed_by(fill, found if named else map(unname, found)):
        grid = after.context.observation.grid
        new = grid[added(before.context.observation, after.context.observation)]
        same = new[:, :2] == grid[tuple(before.context.observation.goal)][:2]
        assert not same.all(axis=1).any()
        shared += same.sum(axis=0)
    assert (shared > 0).all() == shared.any() == named


def test_what_is_added_stands_between_the_symmetries_and_the_clutter_of_babyai():
    plain = more.Settings(augment=True, clutter=0.4)
    chosen = more.choose(dataclasses.replace(plain, false_starts=0.5, detours=0.5))
    window, key = plain_windows()[0], jax.random.key(3)
    assert len(chosen) == 4 and more.choose(more.Settings()) == []
    for others in (more.choose(plain), [chosen[0], chosen[3]]):
        for change, other in zip(augmentation.choose_augmentations(plain), others, strict=True):
            pairs = (jax.tree.leaves(each(key, window)) for each in (change, other))
            assert all(map(np.array_equal, *pairs))
