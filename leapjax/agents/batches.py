"""Draws training batches from demonstrations, and applies the domain's augmentations."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.agents.base import Setup
from leapjax.data import windows
from leapjax.data.windows import Steps
from leapjax.domain import Augmentation, Domain
from leapjax.errors import UserError
from leapjax.types import Demonstration, TransitionWindow, Window


def window_batches(
    setup: Setup, cut: Callable[[Steps, jax.Array, int, int, int], Window] = windows.window
) -> Callable[[jax.Array, Steps], Window]:
    """Makes an agent's `batch`: (key, steps) -> augmented windows `[B, ...]`.

    Args:
        setup: arguments of `make_agent`.
        cut: (steps, index, K, T, end action) -> window: `windows.window` or
            `windows.unrolled_window`.
    """

    def window(steps: Steps, index: jax.Array) -> Window:
        return cut(steps, index, setup.context, setup.horizon, setup.domain.num_actions - 1)

    _check_no_runs(setup)

    def batch(key: jax.Array, steps: Steps) -> Window:
        return _draw(setup, window, key, steps)[0]

    return batch


def run_batches(setup: Setup) -> Callable[[jax.Array, Steps], Window]:
    """Makes an agent's `batch`: (key, steps) -> runs of S consecutive windows `[B / S, S, ...]`.

    All windows of a run get the same random augmentation. A run that reaches the end of its
    demonstration repeats the last window.
    """
    domain, training = setup.domain, setup.training

    def window(steps: Steps, index: jax.Array) -> Window:
        return windows.window(steps, index, setup.context, setup.horizon, domain.num_actions - 1)

    def batch(key: jax.Array, steps: Steps) -> Window:
        step_key, *keys = jax.random.split(key, 1 + len(domain.augmentations.functions))
        count = training.batch // training.consecutive
        starts = windows.sample_steps(step_key, steps, count, training.windows)
        ahead = jnp.minimum(jnp.arange(training.consecutive), steps.remaining[starts][:, None] - 1)
        each = jax.vmap(window, in_axes=(None, 0))
        runs = jax.vmap(each, in_axes=(None, 0))(steps, starts[:, None] + ahead)
        return _augment(domain, keys, runs, lambda augment: jax.vmap(augment, in_axes=(None, 0)))

    return batch


def transition_batches(setup: Setup) -> Callable[[jax.Array, Steps], TransitionWindow]:
    """Makes an agent's `batch`: (key, steps) -> augmented transitions `[B, ...]`.

    It divides rewards by the `reward_scale` of the method's settings.
    """

    def window(steps: Steps, index: jax.Array) -> Window:
        end = setup.domain.num_actions - 1
        return windows.transition_window(steps, index, setup.context, end)

    _check_no_runs(setup)

    def batch(key: jax.Array, steps: Steps) -> TransitionWindow:
        drawn, indices = _draw(setup, window, key, steps)
        rewards = drawn.context.rewards / setup.settings.reward_scale
        context = drawn.context._replace(rewards=rewards)
        return TransitionWindow(context, steps.terminated[indices])

    return batch


def join_demonstrations(domain: Domain, demonstrations: Sequence[Demonstration]) -> list[Steps]:
    """Joins demonstrations into the parts that a domain splits them into; `[]` if there are none.

    The arrays are padded, so that programs for one training seed serve most others.
    """
    if not demonstrations:
        return []
    parts = domain.split(demonstrations) if domain.split else [demonstrations]
    return [windows.concatenate(part, domain.augmentations.extras, padded=True) for part in parts]


def make_blank_steps(domain: Domain) -> Steps:
    """Makes one blank step of a domain, to compile training before there are data."""
    states = jax.tree.map(lambda x: np.stack([x, x]), domain.blank)
    actions, rewards = np.zeros(1, np.int32), np.zeros(1, np.float32)
    blank = Demonstration(states, actions, rewards, True, False, 0)
    return windows.concatenate([blank], domain.augmentations.extras)


def _check_no_runs(setup: Setup) -> None:
    """Checks that windows are drawn one by one: only `run_batches` draws runs of windows."""
    if setup.training.consecutive > 1:
        raise UserError(
            f"{setup.training.consecutive} consecutive windows: only LEAP with architecture paper "
            "encodes the states of windows in a row once",
            "consecutive",
        )


def _draw(
    setup: Setup, window: Callable[[Steps, jax.Array], Window], key: jax.Array, steps: Steps
) -> tuple[Window, jax.Array]:
    """Draws augmented windows `[B, ...]`; also returns the indices `[B]` of their steps."""
    domain, training = setup.domain, setup.training
    step_key, *keys = jax.random.split(key, 1 + len(domain.augmentations.functions))
    indices = windows.sample_steps(step_key, steps, training.batch, training.windows)
    drawn = jax.vmap(window, in_axes=(None, 0))(steps, indices)
    return _augment(domain, keys, drawn), indices


def _augment(
    domain: Domain,
    keys: Sequence[jax.Array],
    examples: Window,
    lift: Callable[[Augmentation], Augmentation] = lambda augment: augment,
) -> Window:
    """Augments a batch, with the domain's last augmentation first.

    Args:
        domain: domain whose augmentations to apply.
        keys: key of each augmentation.
        examples: windows or runs of windows, `[B, ...]`.
        lift: turns an augmentation of a window into an augmentation of an example.
    """
    count = examples.actions.shape[0]
    for augment, key in reversed(list(zip(domain.augmentations.functions, keys, strict=True))):
        examples = jax.vmap(lift(augment))(jax.random.split(key, count), examples)
    return examples
