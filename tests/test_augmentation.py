"""Augmentation of the library, and what models of `experiments.properties` are trained with."""

import functools
from collections import Counter
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX
from minigrid.core.grid import Grid

from experiments import augmentation
from experiments.augmentation import Settings, add_detour, add_false_start, add_lookalikes
from leapjax.data import windows
from leapjax.domains.babyai import demonstrations, levels, vocabulary
from leapjax.domains.babyai.adapter import END
from leapjax.domains.babyai.augmentation import (
    add_clutter,
    apply_symmetries,
    mark_needed_cells,
)
from leapjax.domains.babyai.augmentation.goals import hide_goal
from leapjax.domains.babyai.augmentation.words import find_words
from leapjax.domains.babyai.dynamics import FORWARD, LAVA, roll
from tests.dynamics import FRONT, stepped
from tests.oracles import slow_path_lengths
from tests.programs import only_long

EMPTY, KEY, BALL, BOX = 1, 5, 6, 7
WORDS = find_words()
augment = jax.jit(
    lambda key, window, exchange=True: apply_symmetries(key, window, WORDS, exchange),
    static_argnames="exchange",
)
clutter = jax.jit(add_clutter)
window_at = jax.jit(windows.window, static_argnums=(2, 3, 4))
same = np.testing.assert_array_equal


def steps_of(found):
    return jax.tree.map(jnp.asarray, windows.concatenate(found, mark_needed_cells))


@functools.cache
def collected(name, count=6):
    return demonstrations.collect(levels.find_level(name), count, seed=1).demonstrations


@functools.cache
def whole_windows(name, horizon=32):
    """The window at the start of each of some demonstrations."""
    steps = steps_of([d for d in collected(name) if len(d.actions) < horizon])
    return [window_at(steps, i, 0, horizon, END) for i in steps.starts]


@functools.cache
def every_window(horizon=10, level="GoToLocalS8N1", episodes=6):
    """Windows of an empty room, or of another level, from every step."""
    steps = steps_of(collected(level, episodes))
    return [window_at(steps, i, 0, horizon, END) for i in range(steps.actions.shape[0])]


def changed_by(change, found, keys=12):
    """Pairs of windows that an augmentation changed: before and after."""
    change = jax.jit(change)
    for number, window in enumerate(jax.device_get(found)):
        for key in range(keys):
            after = jax.device_get(change(jax.random.key(100 * number + key), window))
            if added(window.context.observation, after.context.observation).any():
                yield window, after


def added(before, after):
    """`[S, S]` bool: where a state differs."""
    return (np.asarray(before.grid) != np.asarray(after.grid)).any(axis=-1)


def walked(state, actions):
    for action in actions[actions != END]:
        state = stepped(state, int(action))
    return state


def faced(state):
    return tuple((state.pose[:2] + FRONT[state.pose[2]]).tolist())


def shortest(state):
    """Moves until the goal is touched."""
    grid, _ = Grid.decode(np.asarray(state.grid))
    start = tuple(state.pose[:2].tolist())
    grid.set(*start, None)  # the agent is not in its own way
    return slow_path_lengths(grid, start)[tuple(state.goal.tolist())]


@pytest.mark.parametrize(
    ("name", "exchange"),
    [("GoToLocalS8N7", True), ("GoToObjMazeS4R2Close", False), ("PickUpLoc", True)],
)
def test_an_augmented_demonstration_still_does_what_it_is_told(name, exchange):
    seen = set()
    change = functools.partial(augment, exchange=exchange)
    for _, changed in changed_by(change, whole_windows(name), keys=4):
        start = changed.context.observation
        state = walked(start, changed.actions)
        assert faced(state) == tuple(state.goal)
        kind, colour = state.carried if name == "PickUpLoc" else state.grid[tuple(state.goal)][:2]
        words = vocabulary.decode(start.instruction).split()
        assert {OBJECT_TO_IDX[w] for w in words if w in ("key", "ball", "box", "door")} <= {kind}
        assert {COLOR_TO_IDX[w] for w in words if w in COLOR_TO_IDX} <= {colour}
        # The goal is on the side that the instruction names.
        ahead, offset = np.array(FRONT[start.pose[2]]), start.goal - start.pose[:2]
        right = np.array([-ahead[1], ahead[0]])
        sides = {"front": ahead, "behind": -ahead, "left": -right, "right": right}
        assert all(offset @ side > 0 for word, side in sides.items() if word in words)
        seen.add((kind, colour, changed.actions.tobytes()))
    assert len(seen) > 8


def test_augmentation_covers_the_symmetries_and_depends_on_its_key():
    window = whole_windows("GoToLocalS8N7")[0]
    state = window.context.observation
    (x, y), side = (int(v) for v in state.goal), state.grid.shape[0]

    def draw(key, exchange=True):
        """The target's row, kind and colour."""
        changed = augment(jax.random.key(key), window, exchange).context.observation
        row = int(changed.goal[1])
        return (row, *np.asarray(changed.grid)[x, row, :2].tolist())

    draws = [draw(key) for key in range(200)]
    assert draws[:20] == [draw(key) for key in range(20)]
    rows, kinds, colours = (Counter(column) for column in zip(*draws, strict=True))
    assert rows.keys() == {y, side - 1 - y} and min(rows.values()) > 60
    assert kinds.keys() == {KEY, BALL, BOX} and min(kinds.values()) > 40
    assert len(colours) == 6 and min(colours.values()) > 15
    assert {draw(key, False)[1] for key in range(20)} == {int(state.grid[x, y, 0])}


@pytest.mark.parametrize(
    ("name", "unrolled"),
    [("GoToObjMazeS4R2Close", None), ("GoToSeqS5R2", None), ("GoToLocalS7N5", 0), ("PickUpLoc", 2)],
)
def test_other_moments_of_a_window_are_transformed_with_the_present(name, unrolled):
    """The past; or the future of a window that is unrolled from a step."""
    demonstration = next(d for d in collected(name, 20) if len(d.actions) > 6)
    steps, mirrored = steps_of([demonstration]), set()
    if unrolled is None:
        window = window_at(steps, jnp.int32(4), 3, 2, END)
        blank = augment(jax.random.key(0), window_at(steps, jnp.int32(0), 3, 2, END))
        assert not any(leaf.any() for leaf in jax.tree.leaves(blank.context.past))
    else:  # from the first step on more states are known than steps were made
        unroll = jax.jit(windows.unrolled_window, static_argnums=(2, 3, 4))
        window = unroll(steps, unrolled, 0, 4, END)
    for key in range(8):
        changed = jax.device_get(augment(jax.random.key(key), window))
        past = [jax.tree.map(lambda x, i=i: x[i], changed.context.past) for i in range(3)]
        actions = changed.context.actions if unrolled is None else changed.actions[:-1]
        moments = pairwise([*past, changed.context.observation])
        for (before, after), action in zip(moments, actions, strict=True):
            same(stepped(before, int(action)).pose, after.pose)
            same(before.instruction, after.instruction)
            same(before.goal, after.goal)
        mirrored.add(bool((past[0].pose != window.context.past.pose[0]).any()))
    assert len(mirrored) == 2


@pytest.mark.parametrize("name", ["GoToObjMazeS4", "PickUpLoc"])
def test_in_clutter_a_demonstration_stays_possible_and_shortest(name):
    filled = 0
    for window, changed in changed_by(lambda k, w: add_clutter(k, w, 1.0), whole_windows(name), 4):
        before, start = window.context.observation, changed.context.observation
        new = start.grid[added(before, start)]
        assert np.isin(new[:, 0], (KEY, BALL, BOX)).all() and (new[:, 1] < 6).all()
        assert (new[:, :2] != before.grid[tuple(before.goal)][:2]).all()  # nor can it be meant
        plain, state = (walked(each, window.actions) for each in (before, start))
        same(state.pose, plain.pose)
        same(state.carried, plain.carried)
        assert shortest(start) == shortest(before)
        filled += len(new)
    assert filled > 100


def test_clutter_is_unlike_a_target_that_is_picked_up_meanwhile():
    """In the last transition of a demonstration the target's cell is empty afterwards."""
    steps, seen = steps_of(collected("PickUpLoc", 12)), 0
    transition_at = jax.jit(windows.transition_window, static_argnums=(2, 3))
    for last in np.asarray(steps.starts + steps.lengths - 1):
        window = transition_at(steps, last, 0, END)
        before = jax.tree.map(lambda x: np.asarray(x[-1]), window.context.past)
        goal = tuple(before.goal)
        assert np.asarray(window.context.observation.grid)[goal][0] == EMPTY
        for key in range(4):
            changed = clutter(jax.random.key(key), window, 1.0).context.past
            after = jax.tree.map(lambda x: np.asarray(x[-1]), changed)
            new = after.grid[added(before, after)]
            assert (new[:, :2] != before.grid[goal][:2]).all()
            seen += len(new)
    assert seen > 100


def test_clutter_leaves_half_of_the_windows_and_fills_up_to_its_share():
    window = whole_windows("GoToLocalS8N7")[0]
    before = jax.device_get(window.context.observation)
    free = (before.grid[..., 0] == EMPTY) & ~np.asarray(window.extras)
    keys = jax.random.split(jax.random.key(0), 400)
    many = jax.vmap(lambda k, share: clutter(k, window, share), in_axes=(0, None))
    grids = np.asarray(many(keys, 0.5).context.observation.grid)
    shares = (grids != before.grid).any(axis=-1)[:, free].mean(axis=1)
    assert 160 < (shares > 0).sum() < 230  # few objects may be none
    assert shares[shares > 0].mean() == pytest.approx(0.25, abs=0.04)
    assert (grids == before.grid)[:, ~free].all()


def test_what_a_demonstration_puts_down_keeps_its_place():
    dropped = 0
    for demonstration in collected("BabyAI-PutNextLocal-v0", 4):
        steps, states = steps_of([demonstration]), demonstration.observations
        for start in range(0, len(demonstration.actions), 3):
            state = jax.tree.map(lambda leaf, i=start: leaf[i].copy(), states)
            state.grid[(state.grid[..., 0] == EMPTY) & ~steps.extras[start]] = (BALL, 0, 0)
            for index, action in enumerate(demonstration.actions[start:], start + 1):
                state = stepped(state, int(action))
                same(state.pose, states.pose[index])
                same(state.carried, states.carried[index])
                dropped += action == 4
    assert dropped


def test_clutter_was_always_there_and_needs_a_goal():
    demonstration = max(collected("GoToObjMazeS4R2Close"), key=lambda d: len(d.actions))
    steps, seen = steps_of([demonstration]), 0
    for start in (4, 1):  # of three past states two were never seen at step 1
        window = window_at(steps, jnp.int32(start), 3, 2, END)
        past, now = window.context.past.grid, window.context.observation
        for key in range(6):
            after = jax.device_get(clutter(jax.random.key(key), window, 1.0)).context
            where = added(now, after.observation)
            seen += int(where.sum())
            known = slice(max(3 - start, 0), None)
            assert not after.past.grid[: known.start].any()
            for old, new in zip(past[known], after.past.grid[known], strict=True):
                same((old != new).any(axis=-1), where)
                same(new[where], after.observation.grid[where])
    assert seen > 20
    aimless = window.context._replace(observation=now._replace(goal=jnp.array([-1, -1])))
    aimless = window._replace(context=aimless)
    jax.tree.map(same, clutter(jax.random.key(1), aimless, 1.0), aimless)


def test_half_of_the_sequences_are_said_the_other_way_round():
    def said(window):
        return vocabulary.decode(window.context.observation.instruction)

    window = next(w for w in whole_windows("GoToSeqS5R2", 200) if ", then" in said(w))
    found = [said(augment(jax.random.key(key), window)) for key in range(100)]
    assert 30 < sum("after you" in each for each in found) < 70


def test_a_false_start_leads_to_where_the_window_began():
    lengths = set()
    for before, after in changed_by(lambda k, w: add_false_start(k, w, 1.0), every_window()):
        state = after.context.observation
        moves = int(after.imitated.argmax())
        assert after.imitated[moves:].all() and not after.imitated[:moves].any()
        same(after.actions[moves:], before.actions[: 10 - moves])
        same(walked(state, after.actions[:moves]).grid, before.context.observation.grid)
        lengths.add(moves)
        assert after.extras[tuple(state.pose[:2])]
    assert lengths == set(range(1, 7))


@pytest.mark.parametrize("name", ["false_starts", pytest.param("detours", marks=only_long)])
def test_what_begins_earlier_never_steps_on_lava(name):
    """Demonstrations walk around it: what is added to them must too."""
    [change] = augmentation.choose(Settings(**{name: 1.0}))
    walk, lava, changed = jax.jit(roll), 0, 0
    for _, after in changed_by(change, every_window(10, "GoToLavaMedium", 20)):
        state, changed = after.context.observation, changed + 1
        lava += (state.grid[..., 0] == LAVA).any()
        cells = walk(state, jnp.asarray(after.actions))[:, :2]
        assert (state.grid[cells[:, 0], cells[:, 1], 0] != LAVA).all()
    assert lava > 50 and changed > 50


def test_a_detour_is_the_shortest_way_and_still_leads_to_the_goal():
    longer = things = 0
    for before, after in changed_by(
        lambda k, w: add_detour(k, w, 1.0, WORDS), every_window(horizon=24)
    ):
        assert after.imitated.all()
        state, goal = after.context.observation, tuple(before.context.observation.goal.tolist())
        assert faced(walked(state, after.actions)) == goal
        moves = int((after.actions == FORWARD).sum()) + 1
        assert moves == after.extras.sum()  # no cell twice, and not the goal
        assert moves == shortest(state)
        longer += moves > np.abs(state.pose[:2] - goal).sum()
        things += (state.grid[..., 0] != before.context.observation.grid[..., 0]).sum() > 4
    assert longer > 10 and things > 10


@pytest.mark.parametrize("named", [True, False])
def test_lookalikes_share_kind_or_colour_with_a_target_that_is_named_but_never_both(named):
    def instruct(window):
        said = jnp.asarray(vocabulary.encode("go to the box", 5))
        seen = window.context.observation._replace(instruction=said)
        return window._replace(context=window.context._replace(observation=seen))

    found, shared = every_window()[:4], np.zeros(2, int)
    found = found if named else list(map(instruct, found))
    for before, after in changed_by(lambda k, w: add_lookalikes(k, w, 1.0, WORDS), found):
        old, new = before.context.observation, after.context.observation
        alike = new.grid[added(old, new)][:, :2] == new.grid[tuple(old.goal)][:2]
        assert not alike.all(axis=1).any()
        shared += alike.sum(axis=0)
    assert (shared > 0).all() == shared.any() == named


def test_goals_are_hidden_in_their_share_of_windows_and_in_all_states():
    """Nothing else changes, and where a goal is shown nothing at all."""
    window = window_at(steps_of(collected("GoToLocalS8N7")[:1]), jnp.int32(2), 3, 4, END)
    keys = jax.random.split(jax.random.key(0), 400)
    changed = jax.jit(jax.vmap(lambda key: hide_goal(key, window, 0.3)))(keys)
    now, past = (np.asarray(part.goal) for part in (changed.context.observation,
                                                    changed.context.past))  # fmt: skip
    hidden = (now == -1).all(axis=1)
    assert 0.2 < hidden.mean() < 0.4 and (past[hidden] == -1).all()
    context = changed.context
    shown = context._replace(
        observation=context.observation._replace(goal=now[~hidden]),
        past=context.past._replace(goal=past[~hidden]),
    )
    same(now[~hidden], np.broadcast_to(window.context.observation.goal, now[~hidden].shape))
    for new, old in zip(jax.tree.leaves(shown), jax.tree.leaves(window.context), strict=True):
        same(new, np.broadcast_to(old, new.shape))
