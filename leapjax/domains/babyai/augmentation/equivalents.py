"""Makes equivalent windows: mirrored, recoloured, with objects exchanged, or restated."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from leapjax.domains.babyai import symmetries
from leapjax.domains.babyai.augmentation.words import GridWords
from leapjax.domains.babyai.observations import Observation
from leapjax.types import Window


def apply_symmetries(
    key: jax.Array, window: Window, words: GridWords, exchange_objects: bool
) -> Window:
    """Mirrors, recolours and restates a window at random, and may exchange kinds of objects.

    Each change is a symmetry of the levels, so the result is as good a demonstration as before.

    Args:
        key: random key.
        window: training window.
        words: token ids of the words to exchange.
        exchange_objects: whether to exchange keys, balls and boxes. They are equivalent in
            demonstrations that unlock no door and toggle no box.
    """
    # JAX arrays are made here: a program sets its number of devices after it makes a domain.
    words = jax.tree.map(jnp.asarray, words)
    flip_key, colour_key, object_key, restate_key = jax.random.split(key, 4)
    colours = jax.random.permutation(colour_key, len(words.colours))
    objects = jnp.arange(symmetries.AGENT + 1)
    kinds = jnp.array(symmetries.INTERCHANGEABLE)
    vocabulary = jnp.arange(words.mirrored.shape[0])
    vocabulary = vocabulary.at[words.colours].set(words.colours[colours])
    if exchange_objects:
        order = jax.random.permutation(object_key, len(kinds))
        objects = objects.at[kinds].set(kinds[order])
        vocabulary = vocabulary.at[words.objects].set(words.objects[order])
    renaming = symmetries.Renaming(colours, objects, vocabulary)
    renamed = _change_states(window, lambda observation: symmetries.rename(observation, renaming))
    restated = _choose_either(restate_key, _restate(renamed, words), renamed)
    return _choose_either(flip_key, _reflect(restated, words.mirrored), restated)


def _restate(window: Window, words: GridWords) -> Window:
    """Restates the instruction of a window: ", then" becomes "after you", and vice versa."""

    def restate(observation: Observation) -> Observation:
        restated = symmetries.restate(observation.instruction, words.then, words.after)
        return observation._replace(instruction=restated)

    return _change_states(window, restate)


def _reflect(window: Window, mirrored_words: jax.Array) -> Window:
    """Mirrors a window."""
    context = window.context
    past = jax.vmap(lambda o: symmetries.reflect(o, mirrored_words))(context.past)
    # Blank states before the start stay blank. (`step` does not give their number, because the past
    # of an unrolled window extends beyond `step`.)
    length = context.actions.shape[0]
    known = (jnp.asarray(context.past.grid) != 0).any(axis=(1, 2, 3))

    def keep_blank(mirrored: jax.Array, original: jax.Array) -> jax.Array:
        return jnp.where(known.reshape(length, *(1,) * (mirrored.ndim - 1)), mirrored, original)

    return window._replace(
        context=context._replace(
            observation=symmetries.reflect(context.observation, mirrored_words),
            past=jax.tree.map(keep_blank, past, context.past),
            actions=symmetries.reflect_actions(context.actions),
        ),
        actions=symmetries.reflect_actions(window.actions),
        extras=window.extras[:, ::-1],
    )


def _change_states(window: Window, change: Callable[[Observation], Observation]) -> Window:
    """Changes every state of a window, including the past ones."""
    context = window.context
    return window._replace(
        context=context._replace(
            observation=change(context.observation), past=jax.vmap(change)(context.past)
        )
    )


def _choose_either(key: jax.Array, first: Window, second: Window) -> Window:
    """Chooses the first or the second window with equal probabilities."""
    take = jax.random.bernoulli(key)
    return jax.tree.map(lambda a, b: jnp.where(take, a, b), first, second)
