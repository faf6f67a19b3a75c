import functools
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from leapjax.data import windows
from leapjax.data.windows import Steps
from leapjax.domains.babyai.augmentation import mark_needed_cells
from leapjax.domains.babyai.observations import Observation
from leapjax.types import Context, Demonstration, Window

SIDE, WORDS, DROP = 8, 3, 4
END, PAD = 6, 8  # of seven actions; MASK, 7, lies between them
LENGTHS = (1, 4, 2, 7)


def make_demonstration(rng: np.random.Generator, steps: int, episode: int) -> Demonstration:
    """Makes random states, whose pose holds the episode and the step."""
    n = steps + 1
    pose = np.stack([np.full(n, episode), np.arange(n), rng.integers(0, 4, n)], axis=1)
    return Demonstration(
        Observation(
            rng.integers(1, 11, (n, SIDE, SIDE, 3)).astype(np.uint8),
            pose.astype(np.int32),
            rng.integers(1, 6, (n, 2)).astype(np.int32),
            rng.integers(1, SIDE, (n, 2)).astype(np.int32),
            rng.integers(1, 30, (n, WORDS)).astype(np.int32),
        ),
        rng.integers(0, END, steps).astype(np.int32),
        (rng.integers(-9, 10, steps) / 4).astype(np.float32),  # sums of quarters are exact
        terminated=episode in (0, 2),
        truncated=episode in (1, 2),
        seed=episode,
    )


def make_demonstrations(seed: int = 0) -> list[Demonstration]:
    rng = np.random.default_rng(seed)
    return [make_demonstration(rng, steps, episode) for episode, steps in enumerate(LENGTHS)]


def join_steps(demonstrations: list[Demonstration]) -> Steps:
    return windows.concatenate(demonstrations, extras=mark_needed_cells)


def on_device(steps: Steps) -> Steps:
    return jax.tree.map(jnp.asarray, steps)


def slow_window(demonstration: Demonstration, start: int, context: int, horizon: int) -> Window:
    """Builds a window one element at a time."""
    states, actions = demonstration.observations, demonstration.actions
    past, taken, given = [], [], []
    for step in range(start - context, start):
        known = step >= 0
        past.append(jax.tree.map(lambda x, s=step, k=known: x[s] if k else 0 * x[0], states))
        taken.append(actions[step] if known else PAD)
        given.append(demonstration.rewards[step] if known else 0)
    blank = jax.tree.map(lambda x: np.zeros((0, *x.shape[1:]), x.dtype), states)
    planned = [actions[i] if i < len(actions) else END for i in range(start, start + horizon)]
    return Window(
        Context(
            jax.tree.map(lambda x: x[start], states),
            jax.tree.map(lambda *xs: np.stack(xs), *past) if past else blank,
            np.array(taken, np.int32),
            np.array(given, np.float32),
            np.int32(start),
            np.float32(sum(demonstration.rewards[:start].tolist())),
        ),
        np.array(planned, np.int32),
        np.ones(horizon, bool),
        np.float32(sum(demonstration.rewards[start:].tolist())),
        slow_free_cells(demonstration, start),
    )


def slow_free_cells(demonstration: Demonstration, start: int) -> np.ndarray:
    """Marks the cells that must stay free, one step at a time."""
    free = np.zeros(demonstration.observations.grid.shape[1:3], bool)
    for step, (x, y, direction) in enumerate(demonstration.observations.pose.tolist()):
        if step < start:
            continue
        free[x, y] = True
        if step < len(demonstration.actions) and demonstration.actions[step] == DROP:
            dx, dy = ((1, 0), (0, 1), (-1, 0), (0, -1))[direction]
            free[min(max(x + dx, 0), len(free) - 1), min(max(y + dy, 0), len(free) - 1)] = True
    return free


def assert_same(actual, expected) -> None:
    """Compares arrays and their dtypes."""
    jax.tree.map(np.testing.assert_array_equal, actual, expected)
    types = jax.tree.map(lambda x: x.dtype, actual)
    assert types == jax.tree.map(lambda x: x.dtype, expected)


def list_steps():
    """Lists the row, the demonstration and the number of each step."""
    steps = [(d, step) for d in make_demonstrations() for step in range(len(d.actions))]
    return [(row, *step) for row, step in enumerate(steps)]


def test_steps_hold_all_episodes_in_order():
    steps = join_steps(make_demonstrations())
    assert steps.lengths.tolist() == [*LENGTHS]
    assert steps.starts.tolist() == [0, 1, 5, 7]
    assert np.flatnonzero(steps.terminated).tolist() == [0, 6]  # the ends of episodes 0 and 2


@pytest.mark.parametrize(("context", "horizon"), [(0, 1), (2, 3), (5, 5)])
def test_windows_equal_the_slow_version(context, horizon):
    steps = on_device(join_steps(make_demonstrations()))
    find = jax.jit(lambda steps, i: windows.window(steps, i, context, horizon, END))
    for row, demonstration, start in list_steps():
        assert_same(find(steps, row), slow_window(demonstration, start, context, horizon))


@pytest.mark.parametrize("context", [0, 2])
def test_transition_windows_hold_the_contexts_before_and_after_a_step(context):
    steps = on_device(join_steps(make_demonstrations()))
    find = jax.jit(lambda steps, i: windows.transition_window(steps, i, context, END))
    for row, demonstration, step in list_steps():
        # One step longer, so that a window can start at the state after the last step.
        states = jax.tree.map(lambda x: np.concatenate([x, x[-1:]]), demonstration.observations)
        actions, rewards = (np.append(x, 0) for x in (demonstration.actions, demonstration.rewards))
        longer = demonstration._replace(observations=states, actions=actions, rewards=rewards)
        found = find(steps, row)
        assert found.actions.shape == (0,)
        assert found.context.actions[-1] == actions[step]
        assert found.context.rewards[-1] == rewards[step]
        np.testing.assert_array_equal(found.extras, slow_free_cells(demonstration, step))
        assert_same(windows.before(found.context), slow_window(longer, step, context, 0).context)
        assert_same(windows.after(found.context), slow_window(longer, step + 1, context, 0).context)


def test_states_keep_their_dtypes():
    """Training and acting must give a network the same dtypes: `~` differs for integers."""
    kinds = {"flags": bool, "pixels": np.uint8, "counts": np.int32, "numbers": np.float32}
    states = {name: np.ones((4, 2), kind) for name, kind in kinds.items()}
    episode = Demonstration(states, np.zeros(3, np.int32), np.zeros(3, np.float32), True, False, 0)
    steps = on_device(windows.concatenate([episode]))

    def find_contexts(steps):
        whole = windows.window(steps, jnp.int32(1), 2, 3, END)
        assert whole.extras == ()  # extras exist only on request
        taken = windows.transition_window(steps, jnp.int32(1), 2, END).context
        unrolled = windows.unrolled_window(steps, jnp.int32(1), 2, 3, END).context
        later = windows.context_at(unrolled, 1, 2)
        return whole.context, windows.before(taken), windows.after(taken), later

    for context in jax.eval_shape(find_contexts, steps):
        for name, kind in kinds.items():
            assert context.past[name].dtype == context.observation[name].dtype == kind


@pytest.mark.parametrize(("context", "horizon"), [(0, 4), (2, 3)])
def test_unrolled_windows_hold_every_context_of_their_plan(context, horizon):
    steps = on_device(join_steps(make_demonstrations()))
    find = jax.jit(lambda s, i: windows.unrolled_window(s, i, context, horizon, END))
    for row, demonstration, start in list_steps():
        n = len(demonstration.actions)
        found = find(steps, row)
        expected = slow_window(demonstration, start, context, horizon)
        np.testing.assert_array_equal(found.actions, expected.actions)
        np.testing.assert_array_equal(found.extras, expected.extras)
        for place in range(horizon):
            at = windows.context_at(found.context, place, context)
            now = min(start + place, n)
            assert_same(
                at.observation, jax.tree.map(lambda x, i=now: x[i], demonstration.observations)
            )
            assert at.step == start + place
            assert at.actions.shape == (context,)
            if start + place < n:
                same = slow_window(demonstration, now, context, 0).context
                assert_same((at.past, at.actions), (same.past, same.actions))


@functools.partial(jax.jit, static_argnums=(2, 3, 4, 5))
def draw(key, steps, batch: int, context: int, horizon: int, by: str) -> Window:
    """Draws a batch as agents do."""
    indices = windows.sample_steps(key, steps, batch, by)
    return jax.vmap(lambda i: windows.window(steps, i, context, horizon, END))(indices)


def sample(batch: int, by: str) -> Window:
    steps = on_device(join_steps(make_demonstrations()))
    return draw(jax.random.key(0), steps, batch, 0, 1, by)


def test_samplings_are_uniform_over_episodes_steps_or_starts():
    def is_uniform(observed):
        return len(observed) == 1 or stats.chisquare(observed).pvalue > 1e-3

    found = {}
    for by in windows.SAMPLINGS:  # how often each step of each episode was drawn
        pose = np.asarray(sample(20_000, by).context.observation.pose)
        found[by] = [
            np.bincount(pose[pose[:, 0] == episode, 1], minlength=length)
            for episode, length in enumerate(LENGTHS)
        ]
    assert is_uniform([c.sum() for c in found["episode"]])
    assert all(is_uniform(c) for c in found["episode"])
    assert not is_uniform(np.concatenate(found["episode"]))
    assert is_uniform(np.concatenate(found["step"]))
    assert not is_uniform([c.sum() for c in found["step"]])
    assert is_uniform([c[0] for c in found["start"]])
    assert not any(c[1:].any() for c in found["start"])
    with pytest.raises(ValueError, match="unknown sampling 'window'"):
        sample(4, "window")


def test_padding_does_not_change_windows():
    steps = join_steps(make_demonstrations())
    padded = windows.concatenate(make_demonstrations(), extras=mark_needed_cells, padded=True)
    assert len(padded.actions) == len(padded.extras) == 16 > len(steps.actions) == padded.count
    assert len(padded.observations.grid) == 32 > len(steps.observations.grid)
    # JAX's CPU devices share aligned arrays, and copy others for each device.
    assert all(leaf.ctypes.data % 64 == 0 for leaf in (padded.actions, padded.observations.grid))
    for by in windows.SAMPLINGS:
        same = [draw(jax.random.key(0), on_device(data), 64, 2, 5, by) for data in (steps, padded)]
        jax.tree.map(np.testing.assert_array_equal, *same)
    # The fingerprint of a run's data does not depend on padding.
    jax.tree.map(np.testing.assert_array_equal, windows.unpadded(padded), steps)
    assert windows.fingerprint(windows.unpadded(padded)) == windows.fingerprint(steps)
    others = windows.concatenate(make_demonstrations(1), extras=mark_needed_cells)
    for different in (padded, others):
        assert windows.fingerprint(different) != windows.fingerprint(steps)


def test_memory_mapped_frames_are_copied_once(tmp_path):
    rows, side = 128, 84
    stored = np.arange(2 * rows * side * side).astype(np.uint8).reshape(2 * rows, side, side)
    np.save(tmp_path / "frames.npy", stored)
    frames = np.load(tmp_path / "frames.npy", mmap_mode="r")
    games = [
        Demonstration(
            frames[first : first + rows], np.zeros(rows - 1, np.int32),
            np.zeros(rows - 1, np.float32), True, False, -1,
        )
        for first in (0, rows)
    ]  # fmt: skip
    tracemalloc.start()
    try:
        steps = windows.concatenate(games, padded=True)
        name = windows.fingerprint(windows.unpadded(steps))
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert stored.nbytes < most < 1.1 * stored.nbytes
    np.testing.assert_array_equal(steps.observations, stored)
    assert name == windows.fingerprint(windows.concatenate(games))


def test_recent_returns_the_last_steps_of_a_context():
    context = Context(
        observation=np.int32(9), past=np.arange(3), actions=np.array([4, 5, 6]),
        rewards=np.array([0.1, 0.2, 0.3]), step=np.int32(3), return_so_far=np.float32(0.6),
    )  # fmt: skip
    for length in (0, 2, 3):
        found = windows.recent(context, length)
        assert found.past.tolist() == [0, 1, 2][3 - length :]
        assert found.actions.tolist() == [4, 5, 6][3 - length :]
        assert found.rewards.tolist() == [0.1, 0.2, 0.3][3 - length :]
        assert (found.observation, found.step) == (9, 3)
