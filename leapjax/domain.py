"""`Domain`: a level of a family of environments, as training and planning need it.

A family is BabyAI, the games of Atari, or one environment of your own. A `DomainType` makes the
`Domain` of each of its levels. To add a family, write both in a folder of its own, and add a line
to `leapjax.domains`.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.environments import Adapter, Criterion
from leapjax.errors import UserError
from leapjax.types import Context, Demonstration, Energy, PyTree, Turned, Window, to_plain_dicts

if TYPE_CHECKING:
    import gymnasium as gym

    from leapjax.models.config import ModelConfig, Sizes
    from leapjax.models.encoder import Encoder

EncoderMaker = Callable[["ModelConfig", "Sizes"], "Encoder"]  # (model, sizes) -> encoder
Encoders = Mapping[str, EncoderMaker]  # by architecture
Statistics = tuple[tuple[tuple[float, ...], ...], ...]
# Statistics of training data, kept in checkpoints: [array of an observation][column][number].
Turn = Callable[..., Turned]  # (key, context, horizon=T) -> turned context
Augmentation = Callable[[jax.Array, Window], Window]  # (key, window) -> changed window
Split = Callable[[Sequence[Demonstration]], Sequence[Sequence[Demonstration]]]


class Collection(NamedTuple):
    """Demonstrations, and a count of the episodes that were dropped.

    Attributes:
        demonstrations: the episodes that can be used.
        dropped: number of dropped episodes, by reason.
    """

    demonstrations: list[Demonstration]
    dropped: Mapping[str, int]


Collect = Callable[[int, int, Callable[[int], None]], Collection]
# (count, training seed, progress) -> demonstrations


class Recording(NamedTuple):
    """An episode of n steps from a data set; its observations may differ from the domain's.

    Attributes:
        observations: `[n + 1, ...]`.
        actions: `[n]` int64.
        rewards: `[n]` float32.
        seed: seed of the environment's reset; negative if unknown.
    """

    observations: Any
    actions: np.ndarray
    rewards: np.ndarray
    seed: int


class Described(NamedTuple):
    """The environment of a data set, as its metadata describe it; unknown fields are `None`.

    Attributes:
        level: id of the environment.
        episodes: number of episodes in the data set.
        arguments: keyword arguments of the environment.
        wrappers: around the environment, the innermost first, each with `name`, `entry_point` and
            `kwargs`.
        max_steps: step limit of the environment.
        spaces: spaces by name, "observation" and "action"; a space that says no more than shapes
            and types is absent.
    """

    level: str | None = None
    episodes: int | None = None
    arguments: Mapping[str, Any] | None = None
    wrappers: Sequence[Mapping[str, Any]] | None = None
    max_steps: int | None = None
    spaces: Mapping[str, "gym.Space"] = {}


class Source(NamedTuple):
    """Where demonstrations are stored, and how they are made and read.

    Attributes:
        default: place to use if the user does not name another.
        exists: (place) -> whether the demonstrations are there.
        make: (place, progress) -> a summary; makes and stores the demonstrations.
        load: (place, training seed) -> at least as many demonstrations as were asked for, or
            UserError.
        amount: number of units that `make` makes; its progress counts them.
        unit: unit of the amount, such as "demonstrations".
    """

    default: str
    exists: Callable[[str], bool]
    make: Callable[[str, Callable[[int], None]], str]
    load: Callable[[str, int], Collection]
    amount: int
    unit: str


def _accept_observations(observations: PyTree, where: str) -> None:
    del observations, where


def _accept_environment(recorded: Described, where: str) -> None:
    del recorded, where


def _make_no_extras(demonstration: Demonstration) -> PyTree:
    del demonstration
    return ()


class Demonstrations(NamedTuple):
    """How demonstrations of a level are made, and how recorded episodes are checked.

    A domain gives `collect`, whose demonstrations the library stores as Minari data sets, or it
    gives `source`. If it gives neither, the user names a data set.

    Attributes:
        collect: (count, training seed, progress) -> `count` demonstrations, or UserError.
        source: source of demonstrations in the domain's own format.
        check: (observations `[n + 1, ...]`, where) -> UserError if a value is out of range.
        check_environment: (description of a data set, where) -> UserError if the data set was
            recorded in another environment.
        replay: (episode with other observations) -> demonstration, or the reason why there cannot
            be one, or `None` if it does not know such observations.
        criterion: decides whether a recorded episode succeeds; `None` if only the environment can.
    """

    collect: Collect | None = None
    source: Source | None = None
    check: Callable[[PyTree, str], None] = _accept_observations
    check_environment: Callable[[Described, str], None] = _accept_environment
    replay: Callable[[Recording], Demonstration | str | None] | None = None
    criterion: Criterion | None = None


class Augmentations(NamedTuple):
    """Random changes of training windows.

    Attributes:
        functions: each (key, window) -> window; the last is applied first.
        extras: (demonstration) -> arrays `[n, ...]` that the functions need for each step; no
            model sees them.
    """

    functions: Sequence[Augmentation] = ()
    extras: Callable[[Demonstration], PyTree] = _make_no_extras


class Scaling(NamedTuple):
    """How numbers are scaled before a network sees them.

    Attributes:
        returns: divisor of returns.
        measure: (demonstrations) -> statistics of the training data; `None` if unused.
        encoders: (statistics) -> encoders that scale observations by them, or UserError if the
            statistics are of other observations.
    """

    returns: float = 1.0
    measure: Callable[[Sequence[Demonstration]], Statistics] | None = None
    encoders: Callable[[Statistics], Encoders] | None = None


class HeldOut(NamedTuple):
    """Levels of a file, which held-out episodes play.

    Attributes:
        name: of the file, with a digest of its contents.
        check: (level seeds) -> UserError if the file has no level for a seed.
    """

    name: str
    check: Callable[[range], None]


class Domain(NamedTuple):
    """One level: its environment, its actions, and how a network reads its observations.

    The first six fields are required; `demonstrations` and `augmentations` matter for training.
    All functions are pure, except `make_adapter` and the functions of `demonstrations`.

    Attributes:
        level: name of the level.
        make_adapter: makes an environment.
        actions: names of the actions; the last ends a plan.
        max_steps: steps of the longest episode.
        blank: an observation of zeros, as NumPy arrays: shapes and types.
        encoders: by architecture, (model, sizes) -> encoder of contexts.
        demonstrations: how demonstrations are made and checked.
        augmentations: random changes of training windows.
        scaling: scaling of returns and observations.
        rules: energy with parameters `()` that is lowest for plans that obey known rules; `None`
            without such rules.
        turn: (key, context, horizon=T) -> the context after a random symmetry of the task, for the
            restarts of LEAP (see `leapjax.energy.symmetric`); `None` without symmetries.
        signature: JSON values that a checkpoint and the level must agree on.
        sizes: by architecture, further such values (see `find_signature`).
        split: (demonstrations) -> demonstrations in parts, each of observations of one shape; a
            batch is of one part. `None` if all observations have one shape.
        held_out: levels of a file, which `make_adapter` then plays; `None` if it draws levels.
        made_from: (name in `leapjax.domains`, settings), from which `make_domain` made the level;
            `None` for an unregistered domain, whose planners cannot be saved.
    """

    level: str
    make_adapter: Callable[[], Adapter]
    actions: tuple[str, ...]
    max_steps: int
    blank: PyTree
    encoders: Encoders
    demonstrations: Demonstrations = Demonstrations()
    augmentations: Augmentations = Augmentations()
    scaling: Scaling = Scaling()
    rules: Energy | None = None
    turn: Turn | None = None
    signature: Mapping[str, Any] = {}
    sizes: Mapping[str, Mapping[str, Any]] = {}
    split: Split | None = None
    held_out: HeldOut | None = None
    made_from: tuple[str, Any] | None = None

    @property
    def num_actions(self) -> int:
        """A, the number of actions, with the end action."""
        return len(self.actions)


class DomainType(NamedTuple):
    """A family of levels.

    Attributes:
        settings: a frozen dataclass: options of encoders, augmentations and environment.
        make: (level, settings) -> domain, or UserError for an unknown level.
        levels: names of the levels in the paper.
    """

    settings: type
    make: Callable[[str, Any], Domain]
    levels: tuple[str, ...]


def drop_files(settings: Any) -> Any:
    """Returns settings of a domain without paths: they name files of held-out levels.

    A network and its training do not depend on such a file.
    """
    fields = [field.name for field in dataclasses.fields(settings)]
    paths = [name for name in fields if isinstance(getattr(settings, name), Path)]
    return dataclasses.replace(settings, **dict.fromkeys(paths))


def measure_statistics(domain: Domain, demonstrations: Sequence[Demonstration]) -> Statistics:
    """Measures the statistics of training data that a level's encoders need, or returns `()`."""
    return domain.scaling.measure(demonstrations) if domain.scaling.measure else ()


def apply_statistics(domain: Domain, statistics: Statistics) -> Domain:
    """Returns a level whose encoders scale by statistics of their training data.

    Raises:
        UserError: the statistics belong to other observations.
    """
    if domain.scaling.encoders is None or not statistics:
        return domain
    return domain._replace(encoders=domain.scaling.encoders(statistics))


def find_signature(domain: Domain, architecture: str) -> dict[str, Any]:
    """Returns the JSON values that a checkpoint of an architecture and a level must agree on."""
    return {**domain.signature, **domain.sizes.get(architecture, {})}


def blank_context(domain: Domain, length: int) -> Context:
    """Makes a context of zeros with K = `length`, in the shapes and types of a level."""
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
    """Checks the structure, shapes and types of a context, also while JAX traces a program.

    Args:
        context: context to check.
        domain: level of the network that reads the context.
        length: K of that network.

    Raises:
        UserError: the network was made for other contexts; names the array that differs.
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
