"""What agents draw from demonstrations: windows, as they are or as a method needs them."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from leapjax.agents.learning import Setup
from leapjax.data import windows
from leapjax.data.windows import Steps
from leapjax.domain import Augmentation, Domain
from leapjax.errors import UserError
from leapjax.types import TransitionWindow, Window


def window_batches(
    setup: Setup, cut: Callable[[Steps, jax.Array, int, int, int], Window] = windows.window
) -> Callable[[jax.Array, Steps], Window]:
    """An agent's `batch` of windows `[B, ...]`, augmented as the domain says.

    Args:
        setup: what it is made from.
        cut: (steps, index, K, T, end action) -> window: `windows.window` or
            `windows.unrolled_window`.
    """

    def window(steps: Steps, index: jax.Array) -> Window:
        return cut(steps, index, setup.context, setup.horizon, setup.domain.num_actions - 1)

    _check_single(setup)

    def batch(key: jax.Array, steps: Steps) -> Window:
        return _draw(setup, window, key, steps)[0]

    return batch


def run_batches(setup: Setup) -> Callable[[jax.Array, Steps], Window]:
    """An agent's `batch` of runs of S windows, `[B / S, S, ...]`, each augmented as a whole.

    A run that gets to the end of its demonstration stays at its last window.
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
        drawn = jax.vmap(each, in_axes=(None, 0))(steps, starts[:, None] + ahead)
        return _augmented(domain, keys, drawn, lambda each: jax.vmap(each, in_axes=(None, 0)))

    return batch


def _check_single(setup: Setup) -> None:
    """Refuses runs of windows, where nothing is won by them."""
    if setup.training.consecutive > 1:
        raise UserError(
            f"{setup.training.consecutive} consecutive windows: only LEAP with architecture paper "
            "encodes the states of windows in a row once",
            "consecutive",
        )


def transition_batches(setup: Setup) -> Callable[[jax.Array, Steps], TransitionWindow]:
    """An agent's `batch` of transitions `[B, ...]`, augmented as the domain says."""

    def window(steps: Steps, index: jax.Array) -> Window:
        end = setup.domain.num_actions - 1
        return windows.transition_window(steps, index, setup.context, end)

    _check_single(setup)

    def batch(key: jax.Array, steps: Steps) -> TransitionWindow:
        drawn, indices = _draw(setup, window, key, steps)
        return TransitionWindow(drawn.context, steps.terminated[indices])

    return batch


def _draw(
    setup: Setup, window: Callable[[Steps, jax.Array], Window], key: jax.Array, steps: Steps
) -> tuple[Window, jax.Array]:
    """Windows `[B, ...]`, augmented, and the indices `[B]` of their steps."""
    domain, training = setup.domain, setup.training
    step_key, *keys = jax.random.split(key, 1 + len(domain.augmentations.functions))
    indices = windows.sample_steps(step_key, steps, training.batch, training.windows)
    drawn = jax.vmap(window, in_axes=(None, 0))(steps, indices)
    return _augmented(domain, keys, drawn), indices


def _augmented(
    domain: Domain,
    keys: Sequence[jax.Array],
    drawn: Window,
    of_example: Callable[[Augmentation], Augmentation] = lambda augment: augment,
) -> Window:
    """Examples `[B, ...]` as a domain augments them: the last augmentation first, by its key.

    `of_example` makes an augmentation of an example from one of a window.
    """
    count = drawn.actions.shape[0]
    for augment, key in reversed(list(zip(domain.augmentations.functions, keys, strict=True))):
        drawn = jax.vmap(of_example(augment))(jax.random.split(key, count), drawn)
    return drawn
