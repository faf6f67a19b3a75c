"""What a run needs of a domain: the only seam between methods and the worlds they act in.

A domain is a family of levels: BabyAI's, the games of Atari, one environment of your own. A
`Domain` describes one level of it, a `DomainType` makes them. To add a domain is to write one
of each, in a folder of its own, and a line in `leapjax.domains`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np

from leapjax.environments import Adapter, Criterion
from leapjax.errors import UserError, did_you_mean
from leapjax.models.encoder import Encoder
from leapjax.models.trajectory import ModelConfig
from leapjax.types import Context, Demonstration, Energy, PyTree, Window, to_plain_dicts

Statistics = tuple[tuple[tuple[float, ...], ...], ...]
# what a network must know of its training data, kept with its checkpoint: by array of an
# observation, by column of it
Augmentation = Callable[[jax.Array, Window], Window]
# (key, window) -> window: one training example as it could have been


class Collection(NamedTuple):
    """Demonstrations, and what was dropped on the way to them."""

    demonstrations: list[Demonstration]
    dropped: Mapping[str, int]  # how many, by the reason


class Recording(NamedTuple):
    """An episode of n steps as somebody else recorded it, with observations of their own."""

    observations: Any  # [n + 1, ...]
    actions: np.ndarray  # [n] int64
    rewards: np.ndarray  # [n] float32
    seed: int  # with which the environment was reset; negative where nobody knows


class Described(NamedTuple):
    """What a data set says of itself; what is wrong with that is said when it is loaded."""

    level: str | None = None  # the id of the environment that it was recorded in
    episodes: int | None = None
    arguments: Mapping[str, Any] | None = None  # of that environment
    wrappers: Sequence[Mapping[str, Any]] | None = None  # around it, the innermost first, each with
    # `name`, `entry_point` and `kwargs`; None: it does not say
    max_steps: int | None = None  # of an episode, by that environment
    spaces: Mapping[str, gym.Space] = {}  # of each "observation" and "action", where it says more
    # than shapes and types


class Source(NamedTuple):
    """Where demonstrations are kept, and how: as Minari data sets, or in a format of their own."""

    default: str  # where they are, if nobody says
    exists: Callable[[str], bool]
    make: Callable[[str, Callable[[int], None]], str]
    # (where, progress) -> writes them; what was made, in words
    load: Callable[[str, int], Collection]
    # (where, training seed) -> as many as are asked for; UserError if there are fewer
    amount: int  # that `make` makes, and tells the progress of
    unit: str  # of the amount, such as "demonstrations"


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
    """One level of a domain. Functions are pure, but for the first two."""

    level: str  # its name
    make_adapter: Callable[[], Adapter]
    collect: Callable[[int, int, Callable[[int], None]], Collection] | None
    # (count, training seed, progress) -> so many demonstrations; UserError if there are none. None:
    # nobody here demonstrates it
    actions: tuple[str, ...]  # names; the last is the end action
    max_steps: int  # of the longest episode
    blank: PyTree  # an observation of zeros, as NumPy arrays: shapes and types
    encoders: Mapping[str, Callable[[ModelConfig, int], Encoder]]  # by architecture, of (model, K)
    augmentations: Sequence[Augmentation] = ()  # (f, g) makes f(g(window)) of a window
    measure: Callable[[Sequence[Demonstration]], Statistics] = _no_statistics
    # what encoders must know of the training data
    with_statistics: Callable[[Statistics], "Domain"] | None = None
    # the same level, with encoders that know so much; None: theirs need to know nothing
    extras: Callable[[Demonstration], PyTree] = _no_extras
    # what augmentations must know of each step, [n, ...]; no model sees it
    check: Callable[[PyTree, str], None] = _nothing_to_check
    # (observations [n + 1, ...], where) -> UserError if a value is out of range
    replay: Callable[[Recording], Demonstration | str | None] | None = None
    # what an episode of other observations is as a demonstration; or why it is none; or None,
    # where nothing is known of such observations
    source: Source | None = None  # of demonstrations; None: `collect`, kept by leapjax.data.storage
    arguments: Mapping[str, Any] | None = None  # JSON values that its environment is made with, and
    # that of data must agree with; None: theirs do not matter
    check_recorded: Callable[[Described, str], None] = _nothing_to_compare
    # (what a data set says of itself, its name) -> UserError if it contradicts the environment in
    # more than `arguments`
    criterion: Criterion | None = None  # when an episode succeeds; None: the environment says so
    rules: Energy | None = None  # what is known without learning; it has no parameters, ()
    shortest_limit: int | None = None  # steps that every episode may last, if that is known
    signature: Mapping[str, Any] = {}  # JSON values that a checkpoint must agree on
    return_scale: float = 1.0  # what returns are divided by before a network sees them
    paper_success: Mapping[str, float] = {}  # the paper's results by method, in percent

    @property
    def num_actions(self) -> int:
        """A, the end action included."""
        return len(self.actions)


class DomainType(NamedTuple):
    """A family of levels."""

    settings: type  # a frozen dataclass: options of encoder and augmentation
    make: Callable[[str, Any], Domain]
    # (level, settings) -> domain; UserError for an unknown level
    levels: tuple[str, ...]  # the paper's
    preset: Callable[[str, str], Mapping[str, Any]]
    # (level, preset) -> options by name, whatever the method; the method's own come after
    tuned: Callable[[str, str, str], Mapping[str, Any]] = lambda level, method, preset: {}
    # (level, method, preset) -> options that a level changes of the method's own


def apply_statistics(domain: Domain, statistics: Statistics) -> Domain:
    """Returns a level whose encoders know statistics of their training data, if they need any.

    Raises:
        UserError: the statistics are not of this level's observations.
    """
    return domain.with_statistics(statistics) if domain.with_statistics and statistics else domain


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
