"""What a run needs of a domain: the only seam between methods and the worlds they act in.

A domain is a family of levels: BabyAI's, the games of Atari, one environment of your own. A
`Domain` describes one level of it, a `DomainType` makes them. To add a domain is to write one
of each, in a folder of its own, and a line in `leapjax.domains`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.environments import Adapter, Criterion
from leapjax.errors import UserError, did_you_mean
from leapjax.types import Context, Demonstration, Energy, PyTree, Window, to_plain_dicts

if TYPE_CHECKING:
    import gymnasium as gym

    from leapjax.models.encoder import Encoder
    from leapjax.models.trajectory import ModelConfig

EncoderMaker = Callable[["ModelConfig", int], "Encoder"]  # (model, K) -> encoder
Statistics = tuple[tuple[tuple[float, ...], ...], ...]
# what a network must know of its training data, kept with its checkpoint: by array of an
# observation, by column of it
Augmentation = Callable[[jax.Array, Window], Window]
# (key, window) -> window: one training example as it could have been


class Collection(NamedTuple):
    """Demonstrations, and what was dropped on the way to them.

    Attributes:
        demonstrations: those that can be used.
        dropped: how many were dropped, by the reason.
    """

    demonstrations: list[Demonstration]
    dropped: Mapping[str, int]


class Recording(NamedTuple):
    """An episode of n steps as somebody else recorded it, with observations of their own.

    Attributes:
        observations: `[n + 1, ...]`.
        actions: `[n]` int64.
        rewards: `[n]` float32.
        seed: with which the environment was reset; negative where nobody knows.
    """

    observations: Any
    actions: np.ndarray
    rewards: np.ndarray
    seed: int


class Described(NamedTuple):
    """What a data set says of itself; what is wrong with that is said when it is loaded.

    Attributes:
        level: the id of the environment that it was recorded in.
        episodes: how many it holds.
        arguments: of that environment.
        wrappers: around it, the innermost first, each with `name`, `entry_point` and `kwargs`;
            None: the data set does not say.
        max_steps: of an episode, by that environment.
        spaces: of each "observation" and "action", where it says more than shapes and types.
    """

    level: str | None = None
    episodes: int | None = None
    arguments: Mapping[str, Any] | None = None
    wrappers: Sequence[Mapping[str, Any]] | None = None
    max_steps: int | None = None
    spaces: Mapping[str, "gym.Space"] = {}


class Source(NamedTuple):
    """Where demonstrations are kept, and how: as Minari data sets, or in a format of their own.

    Attributes:
        default: where they are, if nobody says.
        exists: (where) -> whether they are there.
        make: (where, progress) -> what was made, in words; writes them.
        load: (where, training seed) -> as many as are asked for; UserError if there are fewer.
        amount: how many `make` makes, and tells the progress of.
        unit: of the amount, such as "demonstrations".
    """

    default: str
    exists: Callable[[str], bool]
    make: Callable[[str, Callable[[int], None]], str]
    load: Callable[[str, int], Collection]
    amount: int
    unit: str


def level_numbers(name: str, pattern: str, expected: str, known: Sequence[str]) -> tuple[int, int]:
    """The two numbers of a level's name, such as 3 and 5 of Star3x5.

    Args:
        name: of the level.
        pattern: a regular expression with a group for each number.
        expected: what names are like, for whoever gives another.
        known: examples.

    Raises:
        UserError: the name is not like that.
    """
    found = re.fullmatch(pattern, name)
    if found is None:
        raise UserError(
            f"unknown level {name!r}: expected {expected}, such as "
            f"{', '.join(known)}{did_you_mean(name, known)}"
        )
    return int(found[1]), int(found[2])


def _nothing_to_check(observations: PyTree, where: str) -> None:
    del observations, where


def _no_statistics(demonstrations: Sequence[Demonstration]) -> Statistics:
    del demonstrations
    return ()


def _nothing_to_compare(recorded: Described, where: str) -> None:
    del recorded, where


def _no_extras(demonstration: Demonstration) -> PyTree:
    del demonstration
    return ()


class Domain(NamedTuple):
    """One level of a domain. Functions are pure, except `make_adapter` and `collect`.

    Attributes:
        level: its name.
        make_adapter: makes an environment.
        collect: (count, training seed, progress) -> so many demonstrations, or UserError if there
            are none; None: nobody here demonstrates it.
        actions: names; the last is the end action.
        max_steps: of the longest episode.
        blank: an observation of zeros, as NumPy arrays: shapes and types.
        encoders: by architecture, (model, K) -> encoder.
        augmentations: each (key, window) -> window; (f, g) makes f(g(window)) of a window.
        measure: (demonstrations) -> what encoders must know of the training data.
        encoders_for: (what was measured) -> `encoders` that know it; UserError if it is not of this
            level's observations. None: `encoders` need to know nothing.
        extras: (demonstration) -> what augmentations must know of each step, `[n, ...]`; no model
            sees it.
        check: (observations `[n + 1, ...]`, where) -> UserError if a value is out of range.
        replay: makes a demonstration of an episode of other observations, or says why it is none;
            None where nothing is known of such observations.
        source: of demonstrations; None: `collect`, kept by `leapjax.data.storage`.
        arguments: JSON values that its environment is made with, and that of data must agree with;
            None: theirs do not matter.
        check_recorded: (what a data set says of itself, its name) -> UserError if it contradicts
            the environment in more than `arguments`.
        criterion: when an episode succeeds; None: the environment says so.
        rules: an energy of what is known without learning; it has no parameters, ().
        shortest_limit: steps that every episode may last, if that is known.
        signature: JSON values that a checkpoint must agree on.
        return_scale: what returns are divided by before a network sees them.
        made_from: its domain's name in `leapjax.domains` and the settings that `make_domain` made
            it with; None: it is of no such domain, and no planner of it can be saved.
    """

    level: str
    make_adapter: Callable[[], Adapter]
    collect: Callable[[int, int, Callable[[int], None]], Collection] | None
    actions: tuple[str, ...]
    max_steps: int
    blank: PyTree
    encoders: Mapping[str, EncoderMaker]
    augmentations: Sequence[Augmentation] = ()
    measure: Callable[[Sequence[Demonstration]], Statistics] = _no_statistics
    encoders_for: Callable[[Statistics], Mapping[str, EncoderMaker]] | None = None
    extras: Callable[[Demonstration], PyTree] = _no_extras
    check: Callable[[PyTree, str], None] = _nothing_to_check
    replay: Callable[[Recording], Demonstration | str | None] | None = None
    source: Source | None = None
    arguments: Mapping[str, Any] | None = None
    check_recorded: Callable[[Described, str], None] = _nothing_to_compare
    criterion: Criterion | None = None
    rules: Energy | None = None
    shortest_limit: int | None = None
    signature: Mapping[str, Any] = {}
    return_scale: float = 1.0
    made_from: tuple[str, Any] | None = None

    @property
    def num_actions(self) -> int:
        """A, the end action included."""
        return len(self.actions)


class DomainType(NamedTuple):
    """A family of levels.

    Attributes:
        settings: a frozen dataclass: options of encoder and augmentation.
        make: (level, settings) -> domain; UserError for an unknown level.
        levels: the paper's.
    """

    settings: type
    make: Callable[[str, Any], Domain]
    levels: tuple[str, ...]


def apply_statistics(domain: Domain, statistics: Statistics) -> Domain:
    """Returns a level whose encoders know statistics of their training data, if they need any.

    Raises:
        UserError: the statistics are not of this level's observations.
    """
    if domain.encoders_for is None or not statistics:
        return domain
    return domain._replace(encoders=domain.encoders_for(statistics))


def blank_context(domain: Domain, length: int) -> Context:
    """A context with K = `length` of the right shapes, all zeros."""
    blank = to_plain_dicts(domain.blank)
    past = jax.tree.map(lambda x: np.zeros((length, *x.shape), x.dtype), blank)
    return Context(
        blank,
        past,
        np.zeros(length, np.int32),
        np.zeros(length, np.float32),
        np.zeros((), np.int32),
        np.zeros((), np.float32),
    )


def check_context(context: Context, domain: Domain, length: int) -> None:
    """Refuses what another network would be needed for, while a program is being traced.

    Raises:
        UserError: says what has which shape.
    """
    blank = blank_context(domain, length)
    structures = [str(jax.tree.structure(tree)) for tree in (context, blank)]
    if structures[0] != structures[1]:
        raise UserError(
            f"a context of structure {structures[0]}, but this network was made for "
            f"{structures[1]}: use the level that it was trained with"
        )
    expected, found = jax.tree.leaves_with_path(blank), jax.tree.leaves(context)
    for (path, leaf), given in zip(expected, found, strict=True):
        numbers = given.dtype if hasattr(given, "dtype") else np.result_type(given)
        words = np.dtype(numbers).kind in "OSU"
        inexact = [jnp.issubdtype(each, jnp.inexact) for each in (leaf.dtype, numbers)]
        if words or inexact == [False, True]:
            raise UserError(
                f"the context{jax.tree_util.keystr(path)} has numbers of type {numbers}, but this "
                f"network was made for {leaf.dtype}"
            )
        if np.shape(given) != leaf.shape:
            raise UserError(
                f"the context{jax.tree_util.keystr(path)} has shape {np.shape(given)}, but this "
                f"network was made for {leaf.shape}: use the level and the context length that "
                "it was trained with"
            )
