"""Windows of demonstrations: what one training example is, and how a batch is drawn.

A window starts at one step of one demonstration. It holds the K steps before it, the
state there, and the T actions from there on; past the end of the demonstration the action
is `end`, predicted like any other. States after the start never enter (paper, eq. 4).
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
    """All steps of all demonstrations, one after the other: M steps of E episodes.

    Behind them the arrays may be padded (see `concatenate`).
    """

    observations: PyTree  # [M + E, ...] the states of each episode, its last one included
    state: Array  # [M] int32: where in them the state before each action is; after it: + 1
    actions: Array  # [M] int32
    rewards: Array  # [M] float32
    return_so_far: Array  # [M] float32: the sum of the episode's rewards before this step
    terminated: Array  # [M] bool: the episode came to its end with this step
    step: Array  # [M] int32: steps since the episode began
    remaining: Array  # [M] int32: actions of the episode from here on, this one included
    starts: Array  # [E] int32: the index of each episode's first step
    lengths: Array  # [E] int32: its number of actions
    count: Array  # [] int32: M
    extras: PyTree  # [M, ...] what the domain's augmentation must know; no model sees it


def fingerprint(steps: PyTree) -> str:
    """A name for exactly this data: sixteen hexadecimal digits."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(steps):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        # Not `tobytes`, which copies: the frames of games are gigabytes.
        digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()[:16]


def concatenate(
    demonstrations: Sequence[Demonstration],
    extras: Callable[[Demonstration], PyTree] = lambda demonstration: (),
    padded: bool = False,
) -> Steps:
    """Lays demonstrations out for `window`.

    Args:
        demonstrations: at least one.
        extras: of a demonstration, `[n, ...]` (`Domain.extras`).
        padded: to arrays whose lengths are powers of two. Programs are compiled for lengths: those
            for one training seed then serve most others.
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


def unpadded(steps: Steps) -> Steps:
    """The same steps without what is behind them: views, nothing is copied."""
    count, episodes = int(steps.count), len(steps.starts)
    whole = {name: getattr(steps, name) for name in ("starts", "lengths", "count")}
    observations = jax.tree.map(lambda leaf: leaf[: count + episodes], steps.observations)
    rest = steps._replace(**dict.fromkeys(whole, ()), observations=())
    rest = jax.tree.map(lambda leaf: leaf[:count], rest)
    return rest._replace(**whole, observations=observations)


def _joined(parts: Sequence[Array], padded: bool) -> np.ndarray:
    """Arrays one after the other, copied once: the frames of games are gigabytes, in a file."""
    if not padded:
        return np.concatenate(parts)
    arrays = [np.asarray(part) for part in parts]
    length, dtype = sum(map(len, arrays)), np.result_type(*{array.dtype for array in arrays})
    longer = _zeros((1 << (length - 1).bit_length(), *arrays[0].shape[1:]), dtype)
    np.concatenate(arrays, out=longer[:length])
    return longer


def _zeros(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An array that JAX's CPU devices can share: one that begins anywhere is copied to each."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.zeros(size + ALIGNMENT, np.uint8)
    begin = -memory.ctypes.data % ALIGNMENT
    return memory[begin : begin + size].view(dtype).reshape(shape)


def window(steps: Steps, index: jax.Array, context: int, horizon: int, end: int) -> Window:
    """The window that starts at step `index []`.

    Args:
        steps: the data.
        index: of the current step, in 0 .. M - 1.
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
    """What is known after step `index []`, as a window of K + 1 past steps and no actions.

    So whatever can be done to a window can be done to a transition; see `TransitionWindow`.

    Args:
        steps: the data.
        index: of the step that is taken, in 0 .. M - 1.
        context: K.
        end: the end action, `A - 1`.
    """
    start = window(steps, index, context, 0, end)  # what augmentations must know is of its start
    return start._replace(context=_context(steps, index, context + 1, end, after=1))


def unrolled_window(steps: Steps, index: jax.Array, context: int, horizon: int, end: int) -> Window:
    """A window whose context goes on to the last state that its plan acts in.

    The context has K + T - 1 past steps: up to step `index []`, the K of a window, then those of
    the plan but its last. Past the end of the demonstration there is its last state, and `end`.
    So whatever can be done to a window can be done to its future; see `context_at`.

    Args:
        steps: the data.
        index: of the current step, in 0 .. M - 1.
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
    """The context of an unrolled window as it is after `place` steps of its plan.

    Args:
        unrolled: K + T - 1 past steps.
        place: 0 .. T - 1.
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
    """The context `[K + S - 1]` that holds all states of S windows in a row, leaves `[S, ...]`.

    It is that of the last of them, and goes back as far as that of the first.
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
    """The same context with only the last `length` of its past steps."""
    first = context.actions.shape[0] - length
    return context._replace(
        past=jax.tree.map(lambda leaf: leaf[first:], context.past),
        actions=context.actions[first:],
        rewards=context.rewards[first:],
    )


def before(context: Context) -> Context:
    """The context of a transition (K + 1 past steps) as it was before its step (K of them)."""
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
    """The context of a transition (K + 1 past steps) as it is after its step (K of them)."""
    return context._replace(
        past=jax.tree.map(lambda leaf: leaf[1:], context.past),
        actions=context.actions[1:],
        rewards=context.rewards[1:],
    )


def _at(tree: PyTree, index: jax.Array | int) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _context(steps: Steps, index: jax.Array, length: int, end: int, after: int = 0) -> Context:
    """What is known before step `index []`, or after it: `length` past steps."""
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
    """Indices `[B]` of steps: a function of `key` and the data alone.

    `by` is one of `SAMPLINGS`: "episode" (a uniform demonstration, then a uniform step of it, as
    in the authors' code), "step" (a uniform step, so that long demonstrations count for more) or
    "start" (the first step of a uniform demonstration, for what is planned once).

    Raises:
        ValueError: another `by`.
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
