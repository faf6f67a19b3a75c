"""Windows of demonstrations: the training examples, and how to draw a batch of them.

A window starts at one step of one demonstration. It holds the K steps before this step, the state
at the step, and the next T actions. After the end of the demonstration every action is `end`; the
model predicts it like other actions. States after the start never enter (paper, eq. 3).
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.types import Array, Context, Demonstration, PyTree, Window, pad_token, to_plain_dicts

ALIGNMENT = 64  # bytes
SAMPLINGS = ("episode", "step", "start")


class Steps(NamedTuple):
    """The steps of all demonstrations, one after the other: M steps of E episodes.

    The arrays may have padding after the last step (see `concatenate`).

    Attributes:
        observations: `[M + E, ...]` the states of each episode, with its last state.
        state: `[M]` int32, index in `observations` of the state before each action. The state after
            the action comes next.
        actions: `[M]` int32.
        rewards: `[M]` float32.
        return_so_far: `[M]` float32, sum of the episode's rewards before this step.
        terminated: `[M]` bool, whether the episode came to its end with this step.
        step: `[M]` int32, steps since the episode began.
        remaining: `[M]` int32, number of the episode's actions from this step on.
        starts: `[E]` int32, index of each episode's first step.
        lengths: `[E]` int32, number of each episode's actions.
        count: `[]` int32, M.
        extras: `[M, ...]` arrays that the domain's augmentations need; no model sees them.
    """

    observations: PyTree
    state: Array
    actions: Array
    rewards: Array
    return_so_far: Array
    terminated: Array
    step: Array
    remaining: Array
    starts: Array
    lengths: Array
    count: Array
    extras: PyTree


def fingerprint(steps: PyTree) -> str:
    """Returns sixteen hexadecimal digits that identify the data."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(steps):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        # `tobytes` would copy the data, and frames of games are gigabytes.
        digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()[:16]


def concatenate(
    demonstrations: Sequence[Demonstration],
    extras: Callable[[Demonstration], PyTree] = lambda demonstration: (),
    padded: bool = False,
) -> Steps:
    """Joins demonstrations into one `Steps`, from which `window` reads.

    Args:
        demonstrations: at least one demonstration.
        extras: (demonstration) -> arrays `[n, ...]` for `Steps.extras` (see `Augmentations`).
        padded: whether to pad arrays to lengths that are powers of two. Programs are compiled for
            one length; with padding, the programs for one training seed serve most others.
    """
    lengths = np.array([len(d.actions) for d in demonstrations], np.int32)
    episode = np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)
    step = np.concatenate([np.arange(n, dtype=np.int32) for n in lengths])
    last = step == lengths[episode] - 1
    actions = np.concatenate([d.actions for d in demonstrations]).astype(np.int32)
    rewards = [np.asarray(d.rewards, np.float32) for d in demonstrations]
    before = np.concatenate([np.cumsum(np.append(0, r))[:-1] for r in rewards]).astype(np.float32)
    terminated = last & np.array([d.terminated for d in demonstrations])[episode]

    def join(*parts: PyTree) -> PyTree:
        return jax.tree.map(lambda *leaves: _joined(leaves, padded), *parts)

    return Steps(
        observations=join(*(to_plain_dicts(d.observations) for d in demonstrations)),
        state=join(np.arange(len(step), dtype=np.int32) + episode),
        actions=join(actions),
        rewards=join(*rewards),
        return_so_far=join(before),
        terminated=join(terminated),
        step=join(step),
        remaining=join(lengths[episode] - step),
        starts=np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int32),
        lengths=lengths,
        count=np.int32(len(step)),
        extras=join(*(extras(d) for d in demonstrations)),
    )


def take_turns(parts: Sequence[Steps], by: str) -> Callable[[int], Steps]:
    """Makes a function that chooses the part of the data for each step of training.

    Each part is chosen as often as its share of all windows says, at even distances.

    Args:
        parts: at least one part.
        by: how windows are drawn; see `sample_steps`.
    """
    counts = [float(part.count if by == "step" else len(part.starts)) for part in parts]
    shares = np.cumsum(counts) / sum(counts)

    def choose(step: int) -> Steps:
        # Multiples of the golden ratio fill the interval evenly, however many there are.
        place = step * (math.sqrt(5) - 1) / 2 % 1
        return parts[min(int(np.searchsorted(shares, place, side="right")), len(parts) - 1)]

    return choose


def unpadded(steps: Steps) -> Steps:
    """Returns the steps without their padding, as views: it copies no array."""
    count, episodes = int(steps.count), len(steps.starts)
    whole = {name: getattr(steps, name) for name in ("starts", "lengths", "count")}
    observations = jax.tree.map(lambda leaf: leaf[: count + episodes], steps.observations)
    rest = steps._replace(**dict.fromkeys(whole, ()), observations=())
    rest = jax.tree.map(lambda leaf: leaf[:count], rest)
    return rest._replace(**whole, observations=observations)


def _joined(parts: Sequence[Array], padded: bool) -> np.ndarray:
    """Concatenates arrays, and copies them once: frames of games are gigabytes in a file."""
    if not padded:
        return np.concatenate(parts)
    arrays = [np.asarray(part) for part in parts]
    length, dtype = sum(map(len, arrays)), np.result_type(*{array.dtype for array in arrays})
    longer = _zeros((1 << (length - 1).bit_length(), *arrays[0].shape[1:]), dtype)
    np.concatenate(arrays, out=longer[:length])
    return longer


def _zeros(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Returns aligned zeros, which JAX's CPU devices share; JAX copies unaligned arrays to each."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.zeros(size + ALIGNMENT, np.uint8)
    begin = -memory.ctypes.data % ALIGNMENT
    return memory[begin : begin + size].view(dtype).reshape(shape)


def window(steps: Steps, index: jax.Array, context: int, horizon: int, end: int) -> Window:
    """Returns the window that starts at step `index []`.

    Args:
        steps: the data.
        index: index of the current step, in 0 .. M - 1.
        context: K.
        horizon: T.
        end: the end action, `A - 1`.
    """
    ahead = jnp.arange(horizon)
    rest = steps.remaining[index]
    actions = steps.actions[jnp.minimum(index + ahead, steps.actions.shape[0] - 1)]
    final = index + rest - 1
    return Window(
        _context(steps, index, context, end),
        jnp.where(ahead < rest, actions, end),
        jnp.ones(horizon, bool),
        steps.return_so_far[final] + steps.rewards[final] - steps.return_so_far[index],
        _at(steps.extras, index),
    )


def transition_window(steps: Steps, index: jax.Array, context: int, end: int) -> Window:
    """Returns the context after step `index []`, in a window of K + 1 past steps and no actions.

    Functions of windows, such as augmentations, then work on transitions; see `TransitionWindow`.

    Args:
        steps: the data.
        index: index of the step that is taken, in 0 .. M - 1.
        context: K.
        end: the end action, `A - 1`.
    """
    start = window(steps, index, context, 0, end)  # augmentations need the extras of its start
    return start._replace(context=_context(steps, index, context + 1, end, after=1))


def unrolled_window(steps: Steps, index: jax.Array, context: int, horizon: int, end: int) -> Window:
    """Returns a window whose context goes on to the last state in which its plan acts.

    The context has K + T - 1 past steps: the K steps before step `index []`, then the steps of the
    plan except the last. After the end of the demonstration its last state repeats, with action
    `end`. Functions of windows, such as augmentations, then work on the future; see `context_at`.

    Args:
        steps: the data.
        index: index of the current step, in 0 .. M - 1.
        context: K.
        horizon: T.
        end: the end action, `A - 1`.
    """
    start = window(steps, index, context, horizon, end)
    ahead = jnp.minimum(jnp.arange(horizon), steps.remaining[index])
    states = jax.tree.map(lambda x: x[steps.state[index] + ahead], steps.observations)
    past = start.context.past
    return start._replace(
        context=start.context._replace(
            observation=_at(states, -1),
            past=jax.tree.map(lambda a, b: jnp.concatenate([a, b[:-1]]), past, states),
            actions=jnp.concatenate([start.context.actions, start.actions[:-1]]),
            rewards=jnp.concatenate([start.context.rewards, jnp.zeros(horizon - 1)]),
        )
    )


def context_at(unrolled: Context, place: int, context: int) -> Context:
    """Returns the context of an unrolled window after `place` steps of its plan.

    Args:
        unrolled: context with K + T - 1 past steps; see `unrolled_window`.
        place: number of steps, in 0 .. T - 1.
        context: K.
    """
    states = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b[None]]), unrolled.past, unrolled.observation
    )
    now = place + context
    return unrolled._replace(
        observation=_at(states, now),
        past=jax.tree.map(lambda x: x[place:now], states),
        actions=unrolled.actions[place:now],
        rewards=unrolled.rewards[place:now],
        step=unrolled.step + place,
    )


def joined(run: Window) -> Context:
    """Joins S consecutive windows, leaves `[S, ...]`, into one context with K + S - 1 past steps.

    The context begins with the past of the first window, and ends in the state of the last.
    """
    context = run.context
    first = jax.tree.map(lambda leaf: leaf[0], context)

    def join(past: jax.Array, observations: jax.Array) -> jax.Array:
        return jnp.concatenate([past, observations[:-1]])

    return Context(
        observation=_at(context.observation, -1),
        past=jax.tree.map(join, first.past, context.observation),
        actions=join(first.actions, run.actions[:, 0]),
        rewards=join(first.rewards, jnp.zeros(len(run.actions))),  # as in `unrolled_window`
        step=context.step[-1],
        return_so_far=context.return_so_far[-1],
    )


def recent(context: Context, length: int) -> Context:
    """Returns a context with only the last `length` of its past steps."""
    first = context.actions.shape[0] - length
    return context._replace(
        past=jax.tree.map(lambda leaf: leaf[first:], context.past),
        actions=context.actions[first:],
        rewards=context.rewards[first:],
    )


def before(context: Context) -> Context:
    """Returns the context before a transition's step: K of the K + 1 past steps."""
    reward = context.rewards[-1]
    return Context(
        observation=_at(context.past, -1),
        past=jax.tree.map(lambda leaf: leaf[:-1], context.past),
        actions=context.actions[:-1],
        rewards=context.rewards[:-1],
        step=context.step - 1,
        return_so_far=context.return_so_far - reward,
    )


def after(context: Context) -> Context:
    """Returns the context after a transition's step: the last K of the K + 1 past steps."""
    return context._replace(
        past=jax.tree.map(lambda leaf: leaf[1:], context.past),
        actions=context.actions[1:],
        rewards=context.rewards[1:],
    )


def _at(tree: PyTree, index: jax.Array | int) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _context(steps: Steps, index: jax.Array, length: int, end: int, after: int = 0) -> Context:
    """Returns the context before step `index []`, or after it (`after=1`): `length` past steps."""
    back = jnp.arange(-length, 0) + after
    known = -back <= steps.step[index]
    earlier = jnp.where(known, index + back, 0)

    def take_past(leaf: jax.Array, rows: jax.Array) -> jax.Array:
        shape = (length,) + (1,) * (leaf.ndim - 1)
        zero = jnp.zeros((), leaf.dtype)  # a plain 0 would make booleans integers
        return jnp.where(known.reshape(shape), leaf[rows], zero)

    states = steps.state[earlier]
    return Context(
        observation=_at(steps.observations, steps.state[index] + after),
        past=jax.tree.map(lambda leaf: take_past(leaf, states), steps.observations),
        actions=jnp.where(known, steps.actions[earlier], pad_token(end + 1)),
        rewards=take_past(steps.rewards, earlier),
        step=steps.step[index] + after,
        return_so_far=steps.return_so_far[index] + after * steps.rewards[index],
    )


def sample_steps(key: jax.Array, steps: Steps, batch: int, by: str) -> jax.Array:
    """Draws indices `[B]` of steps, as a function of the key and the data alone.

    Args:
        key: random key.
        steps: the data.
        batch: B.
        by: a name in `SAMPLINGS`. "episode" draws a uniform demonstration, then a uniform step of
            it, as the authors' code does. "step" draws a uniform step, so that long demonstrations
            count for more. "start" draws the first step of a uniform demonstration, for methods
            that plan once.

    Raises:
        ValueError: `by` is not in `SAMPLINGS`.
    """
    if by not in SAMPLINGS:
        raise ValueError(f"unknown sampling {by!r}: expected one of {', '.join(SAMPLINGS)}")
    if by == "step":
        return jax.random.randint(key, (batch,), 0, steps.count)
    episode_key, step_key = jax.random.split(key)
    episode = jax.random.randint(episode_key, (batch,), 0, steps.starts.shape[0])
    if by == "start":
        return steps.starts[episode]
    offset = jax.random.uniform(step_key, (batch,)) * steps.lengths[episode]
    return steps.starts[episode] + offset.astype(jnp.int32)
