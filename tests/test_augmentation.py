"""BabyAI's augmentation, and the further augmentation of `experiments.augmentation`."""

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
assert_equal = np.testing.assert_array_equal


def join_steps(examples):
    return jax.tree.map(jnp.asarray, windows.concatenate(examples, mark_needed_cells))


@functools.cache
def collect_demos(name, count=6):
    return demonstrations.collect(levels.find_level(name), count, seed=1).demonstrations


@functools.cache
def first_windows(name, horizon=32):
    """Returns the window at the start of each short demonstration."""
    steps = join_steps([d for d in collect_demos(name) if len(d.actions) < horizon])
    return [window_at(steps, i, 0, horizon, END) for i in steps.starts]


@functools.cache
def all_windows(horizon=10, level="GoToLocalS8N1", episodes=6):
    """Returns the windows at all steps, of a room with one object or of another level."""
    steps = join_steps(collect_demos(level, episodes))
    return [window_at(steps, i, 0, horizon, END) for i in range(steps.actions.shape[0])]


def find_pairs(change, examples, keys=12):
    """Yields pairs of windows that an augmentation changed: before and after."""
    change = jax.jit(change)
    for number, window in enumerate(jax.device_get(examples)):
        for key in range(keys):
            after = jax.device_get(change(jax.random.key(100 * number + key), window))
            if find_differences(window.context.observation, after.context.observation).any():
                yield window, after


def find_differences(before, after):
    """Returns booleans `[S, S]`: the cells in which two states differ."""
    return (np.asarray(before.grid) != np.asarray(after.grid)).any(axis=-1)


def execute(state, actions):
    for action in actions[actions != END]:
        state = stepped(state, int(action))
    return state


def find_front_cell(state):
    return tuple((state.pose[:2] + FRONT[state.pose[2]]).tolist())


def count_moves(state):
    """Counts the moves until the agent touches the goal."""
    grid, _ = Grid.decode(np.asarray(state.grid))
    start = tuple(state.pose[:2].tolist())
    grid.set(*start, None)  # the agent's own cell is free
    return slow_path_lengths(grid, start)[tuple(state.goal.tolist())]


@pytest.mark.parametrize(
    ("name", "exchange"),
    [("GoToLocalS8N7", True), ("GoToObjMazeS4R2Close", False), ("PickUpLoc", True)],
)
def test_augmented_demonstrations_follow_their_instruction(name, exchange):
    seen = set()
    change = functools.partial(augment, exchange=exchange)
    for _, changed in find_pairs(change, first_windows(name), keys=4):
        start = changed.context.observation
        state = execute(start, changed.actions)
        assert find_front_cell(state) == tuple(state.goal)
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


def test_augmentation_covers_all_symmetries_and_depends_on_its_key():
    window = first_windows("GoToLocalS8N7")[0]
    state = window.context.observation
    (x, y), side = (int(v) for v in state.goal), state.grid.shape[0]

    def draw(key, exchange=True):
        """Returns the row, kind and colour of the target."""
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
def test_past_and_future_states_are_transformed_like_the_current_state(name, unrolled):
    demonstration = next(d for d in collect_demos(name, 20) if len(d.actions) > 6)
    steps, mirrored = join_steps([demonstration]), set()
    if unrolled is None:
        window = window_at(steps, jnp.int32(4), 3, 2, END)
        blank = augment(jax.random.key(0), window_at(steps, jnp.int32(0), 3, 2, END))
        assert not any(leaf.any() for leaf in jax.tree.leaves(blank.context.past))
    else:  # an unrolled window also knows states after its step
        unroll = jax.jit(windows.unrolled_window, static_argnums=(2, 3, 4))
        window = unroll(steps, unrolled, 0, 4, END)
    for key in range(8):
        changed = jax.device_get(augment(jax.random.key(key), window))
        past = [jax.tree.map(lambda x, i=i: x[i], changed.context.past) for i in range(3)]
        actions = changed.context.actions if unrolled is None else changed.actions[:-1]
        moments = pairwise([*past, changed.context.observation])
        for (before, after), action in zip(moments, actions, strict=True):
            assert_equal(stepped(before, int(action)).pose, after.pose)
            assert_equal(before.instruction, after.instruction)
            assert_equal(before.goal, after.goal)
        mirrored.add(bool((past[0].pose != window.context.past.pose[0]).any()))
    assert len(mirrored) == 2


@pytest.mark.parametrize("name", ["GoToObjMazeS4", "PickUpLoc"])
def test_clutter_keeps_demonstrations_possible_and_shortest(name):
    filled = 0
    for window, changed in find_pairs(lambda k, w: add_clutter(k, w, 1.0), first_windows(name), 4):
        before, start = window.context.observation, changed.context.observation
        new = start.grid[find_differences(before, start)]
        assert np.isin(new[:, 0], (KEY, BALL, BOX)).all() and (new[:, 1] < 6).all()
        assert (new[:, :2] != before.grid[tuple(before.goal)][:2]).all()  # unlike the target
        plain, state = (execute(each, window.actions) for each in (before, start))
        assert_equal(state.pose, plain.pose)
        assert_equal(state.carried, plain.carried)
        assert count_moves(start) == count_moves(before)
        filled += len(new)
    assert filled > 100


def test_clutter_differs_from_a_target_that_was_picked_up():
    """After the last transition of a demonstration the target's cell is empty."""
    steps, seen = join_steps(collect_demos("PickUpLoc", 12)), 0
    transition_at = jax.jit(windows.transition_window, static_argnums=(2, 3))
    for last in np.asarray(steps.starts + steps.lengths - 1):
        window = transition_at(steps, last, 0, END)
        before = jax.tree.map(lambda x: np.asarray(x[-1]), window.context.past)
        goal = tuple(before.goal)
        assert np.asarray(window.context.observation.grid)[goal][0] == EMPTY
        for key in range(4):
            changed = clutter(jax.random.key(key), window, 1.0).context.past
            after = jax.tree.map(lambda x: np.asarray(x[-1]), changed)
            new = after.grid[find_differences(before, after)]
            assert (new[:, :2] != before.grid[goal][:2]).all()
            seen += len(new)
    assert seen > 100


def test_clutter_changes_half_of_the_windows_and_fills_up_to_its_share():
    window = first_windows("GoToLocalS8N7")[0]
    before = jax.device_get(window.context.observation)
    free = (before.grid[..., 0] == EMPTY) & ~np.asarray(window.extras)
    keys = jax.random.split(jax.random.key(0), 400)
    many = jax.vmap(lambda k, share: clutter(k, window, share), in_axes=(0, None))
    grids = np.asarray(many(keys, 0.5).context.observation.grid)
    shares = (grids != before.grid).any(axis=-1)[:, free].mean(axis=1)
    assert 160 < (shares > 0).sum() < 230  # a low share may add 0 objects
    assert shares[shares > 0].mean() == pytest.approx(0.25, abs=0.04)
    assert (grids == before.grid)[:, ~free].all()


def test_needed_cells_include_cells_where_objects_are_dropped():
    dropped = 0
    for demonstration in collect_demos("BabyAI-PutNextLocal-v0", 4):
        steps, states = join_steps([demonstration]), demonstration.observations
        for start in range(0, len(demonstration.actions), 3):
            state = jax.tree.map(lambda leaf, i=start: leaf[i].copy(), states)
            state.grid[(state.grid[..., 0] == EMPTY) & ~steps.extras[start]] = (BALL, 0, 0)
            for index, action in enumerate(demonstration.actions[start:], start + 1):
                state = stepped(state, int(action))
                assert_equal(state.pose, states.pose[index])
                assert_equal(state.carried, states.carried[index])
                dropped += action == 4
    assert dropped


def test_clutter_appears_in_all_states_and_needs_a_goal():
    demonstration = max(collect_demos("GoToObjMazeS4R2Close"), key=lambda d: len(d.actions))
    steps, seen = join_steps([demonstration]), 0
    for start in (4, 1):  # step 1 has a single past state, the other two are blank
        window = window_at(steps, jnp.int32(start), 3, 2, END)
        past, now = window.context.past.grid, window.context.observation
        for key in range(6):
            after = jax.device_get(clutter(jax.random.key(key), window, 1.0)).context
            where = find_differences(now, after.observation)
            seen += int(where.sum())
            known = slice(max(3 - start, 0), None)
            assert not after.past.grid[: known.start].any()
            for old, new in zip(past[known], after.past.grid[known], strict=True):
                assert_equal((old != new).any(axis=-1), where)
                assert_equal(new[where], after.observation.grid[where])
    assert seen > 20
    aimless = window.context._replace(observation=now._replace(goal=jnp.array([-1, -1])))
    aimless = window._replace(context=aimless)
    jax.tree.map(assert_equal, clutter(jax.random.key(1), aimless, 1.0), aimless)


def test_half_of_the_sequences_are_restated():
    def sentence(window):
        return vocabulary.decode(window.context.observation.instruction)

    window = next(w for w in first_windows("GoToSeqS5R2", 200) if ", then" in sentence(w))
    examples = [sentence(augment(jax.random.key(key), window)) for key in range(100)]
    assert 30 < sum("after you" in each for each in examples) < 70


def test_false_starts_lead_to_the_first_state_of_the_window():
    lengths = set()
    for before, after in find_pairs(lambda k, w: add_false_start(k, w, 1.0), all_windows()):
        state = after.context.observation
        moves = int(after.imitated.argmax())
        assert after.imitated[moves:].all() and not after.imitated[:moves].any()
        assert_equal(after.actions[moves:], before.actions[: 10 - moves])
        assert_equal(execute(state, after.actions[:moves]).grid, before.context.observation.grid)
        lengths.add(moves)
        assert after.extras[tuple(state.pose[:2])]
    assert lengths == set(range(1, 7))


@pytest.mark.parametrize("name", ["false_starts", pytest.param("detours", marks=only_long)])
def test_prepended_moves_avoid_lava(name):
    """Demonstrations avoid lava, so moves that an augmentation prepends must, too."""
    [change] = augmentation.choose(Settings(**{name: 1.0}))
    walk, lava, changed = jax.jit(roll), 0, 0
    for _, after in find_pairs(change, all_windows(10, "GoToLavaMedium", 20)):
        state, changed = after.context.observation, changed + 1
        lava += (state.grid[..., 0] == LAVA).any()
        cells = walk(state, jnp.asarray(after.actions))[:, :2]
        assert (state.grid[cells[:, 0], cells[:, 1], 0] != LAVA).all()
    assert lava > 50 and changed > 50


def test_detours_are_shortest_paths_to_the_goal():
    longer = obstructed = 0
    for before, after in find_pairs(
        lambda k, w: add_detour(k, w, 1.0, WORDS), all_windows(horizon=24)
    ):
        assert after.imitated.all()
        state, goal = after.context.observation, tuple(before.context.observation.goal.tolist())
        assert find_front_cell(execute(state, after.actions)) == goal
        moves = int((after.actions == FORWARD).sum()) + 1
        assert moves == after.extras.sum()  # distinct cells, without the goal
        assert moves == count_moves(state)
        longer += moves > np.abs(state.pose[:2] - goal).sum()
        obstructed += (state.grid[..., 0] != before.context.observation.grid[..., 0]).sum() > 4
    assert longer > 10 and obstructed > 10


@pytest.mark.parametrize("named", [True, False])
def test_lookalikes_share_kind_or_colour_of_a_named_target_but_not_both(named):
    def instruct(window):
        sentence = jnp.asarray(vocabulary.encode("go to the box", 5))
        seen = window.context.observation._replace(instruction=sentence)
        return window._replace(context=window.context._replace(observation=seen))

    examples, shared = all_windows()[:4], np.zeros(2, int)
    examples = examples if named else list(map(instruct, examples))
    for before, after in find_pairs(lambda k, w: add_lookalikes(k, w, 1.0, WORDS), examples):
        old, new = before.context.observation, after.context.observation
        alike = new.grid[find_differences(old, new)][:, :2] == new.grid[tuple(old.goal)][:2]
        assert not alike.all(axis=1).any()
        shared += alike.sum(axis=0)
    assert (shared > 0).all() == shared.any() == named


def test_a_share_of_windows_hides_the_goal_in_all_states():
    """Other arrays do not change, nor do windows that show the goal."""
    window = window_at(join_steps(collect_demos("GoToLocalS8N7")[:1]), jnp.int32(2), 3, 4, END)
    keys = jax.random.split(jax.random.key(0), 400)
    changed = jax.jit(jax.vmap(lambda key: hide_goal(key, window, 0.3)))(keys)
    now, past = (np.asarray(part.goal) for part in (changed.context.observation,
                                                    changed.context.past))  # fmt: skip
    hidden = (now == -1).all(axis=1)
    assert 0.2 < hidden.mean() < 0.4 and (past[hidden][:, 1:] == -1).all()
    assert (past[hidden][:, 0] == 0).all()  # the blank state before the start, as in play
    context = changed.context
    shown = context._replace(
        observation=context.observation._replace(goal=now[~hidden]),
        past=context.past._replace(goal=past[~hidden]),
    )
    assert_equal(now[~hidden], np.broadcast_to(window.context.observation.goal, now[~hidden].shape))
    for new, old in zip(jax.tree.leaves(shown), jax.tree.leaves(window.context), strict=True):
        assert_equal(new, np.broadcast_to(old, new.shape))
