"""What puzzles share: an adapter, demonstrations, augmented windows, and files of puzzles."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from leapjax import files
from leapjax.data.seeds import UNSEEN
from leapjax.data.solved import collect_solved
from leapjax.domain import Demonstrations, HeldOut
from leapjax.environments import Transition
from leapjax.errors import UserError
from leapjax.types import Array, Context, Demonstration, PyTree, Turned, Window, pad_token

O = TypeVar("O")  # noqa: E741
P = TypeVar("P")


class PuzzleAdapter(abc.ABC, Generic[O]):
    """A puzzle as the rollout sees it: a subclass draws puzzles and applies actions.

    Attributes:
        num_actions: A, the end action included.
        solution: `[n]` actions that solve the current puzzle.
    """

    num_actions: int
    solution: Array

    @abc.abstractmethod
    def draw(self, seed: int) -> tuple[O, Array]:
        """Returns the first observation of a seed's puzzle, and the actions of a solution."""

    @abc.abstractmethod
    def move(self, observation: O, action: int) -> tuple[O, bool | None]:
        """Returns the observation after an action.

        The second value tells whether the puzzle is solved; `None` if the episode goes on.
        """

    def reset(self, seed: int) -> O:
        """Draws the puzzle of a seed."""
        self._observation, self.solution = self.draw(seed)
        return self._observation

    def step(self, action: int) -> Transition:
        """Takes one action; a solved puzzle gives a reward of 1."""
        self._observation, solved = self.move(self._observation, action)
        success = bool(solved)
        return Transition(self._observation, float(success), solved is not None, False, success)


def demonstrate(
    make_adapter: Callable[[], PuzzleAdapter], check: Callable[[PyTree, str], None]
) -> Demonstrations:
    """Makes the demonstrations of a puzzle: its solutions.

    Args:
        make_adapter: makes the environment.
        check: (observations `[n + 1, ...]`, where) -> UserError if an episode solves no puzzle.
    """
    collect = functools.partial(collect_solved, make_adapter, lambda adapter: adapter.solution)
    return Demonstrations(collect, check=check)


def repeat(puzzle: PyTree, demonstration: Demonstration) -> PyTree:
    """Repeats arrays for every step of a demonstration, as augmentations need them: `[n, ...]`."""
    steps = len(demonstration.actions)
    return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (steps, *np.shape(leaf))), puzzle)


def rewrite(
    window: Window,
    find_place: Callable[[PyTree], jax.Array],
    solution: jax.Array,
    observe: Callable[[jax.Array], PyTree],
    end: int,
) -> Window:
    """Makes the window of another puzzle at the same places of its solution.

    Args:
        window: window to change; its context may go on to the plan's last state, see
            `leapjax.data.windows.unrolled_window`.
        find_place: (observation) -> `[]` number of actions that the solution has before it.
        solution: `[n]` all actions of the new puzzle's solution.
        observe: (place) -> observation of the new puzzle after so many actions.
        end: the end action.
    """
    context, pad = window.context, pad_token(end + 1)
    earlier, known = find_place(context.past), context.actions != pad  # [K]

    def read(places: jax.Array) -> jax.Array:
        inside = places < solution.shape[0]
        return jnp.where(inside, solution[jnp.where(inside, places, 0)], end)

    def observe_past(place: jax.Array, known: jax.Array) -> PyTree:
        return jax.tree.map(lambda leaf: jnp.where(known, leaf, 0), observe(place))

    ahead = context.step + jnp.arange(window.actions.shape[0])  # an action a step
    context = context._replace(
        observation=observe(find_place(context.observation)),
        past=jax.vmap(observe_past)(earlier, known),
        actions=jnp.where(known, read(earlier), pad),
    )
    return window._replace(context=context, actions=read(ahead))


def turn_whole(
    context: Context, length: int, begins: jax.Array, horizon: int, actions: int,
    draw: Callable[[], tuple[PyTree, jax.Array, jax.Array]],
) -> Turned:  # fmt: skip
    """Turns a puzzle for plans of its whole solution; see `leapjax.types.Turned`.

    A plan that begins later, or is shorter, would write other parts of the turned puzzle. Then the
    puzzle stays as it is.

    Args:
        context: context of the plan.
        length: n, actions of a solution.
        begins: `[]` bool: whether the plan begins with the first action.
        horizon: T.
        actions: A, the end action included.
        draw: returns the turned observation, the places `[n]`, and names `[n, k]` or `[k]` of the
            first k actions; the others keep their names.
    """
    names = jnp.tile(jnp.arange(actions), (horizon, 1))
    still = Turned(context, jnp.arange(horizon), names)
    if horizon < length:
        return still
    observation, places, renamed = draw()
    turned = Turned(
        context._replace(observation=observation),
        still.places.at[:length].set(places),
        names.at[:length, : renamed.shape[-1]].set(renamed),
    )
    return jax.tree.map(lambda new, old: jnp.where(begins, new, old), turned, still)


@dataclasses.dataclass(frozen=True)
class PuzzleFile(Generic[P]):
    """Puzzles of a text file, one a line. The first belongs to the first test episode.

    Blank lines are skipped, and the rest of a line after #.

    Attributes:
        path: of the file.
        kind: plural noun for the puzzles, such as "boards", for messages.
        read: (text of a line) -> puzzle, or UserError.
    """

    path: Path
    kind: str
    read: Callable[[str], P]

    @functools.cached_property
    def lines(self) -> list[tuple[int, str]]:
        """The number and the text of each line that holds a puzzle."""
        found = files.read_text(self.path).split("\n")
        texts = [line.partition("#")[0].strip() for line in found]
        return [(number, text) for number, text in enumerate(texts, start=1) if text]

    @property
    def held_out(self) -> HeldOut:
        """The file as levels that held-out episodes play."""
        return HeldOut(files.describe(self.path), self.check)

    def find(self, seed: int) -> P:
        """Reads the puzzle of a level seed.

        Raises:
            UserError: the file has no puzzle for the seed, or its line cannot be read.
        """
        if not UNSEEN <= seed < UNSEEN + len(self.lines):
            raise UserError(
                f"{self.path} has {len(self.lines)} {self.kind}, which are the test levels of the "
                f"seeds from {UNSEEN} on: it has no level of seed {seed}",
                "test_seed", "validation",
            )  # fmt: skip
        return self.read_line(seed - UNSEEN)

    def read_line(self, place: int) -> P:
        """Reads the puzzle at a place of `lines`.

        Raises:
            UserError: its line cannot be read.
        """
        number, text = self.lines[place]
        try:
            return self.read(text)
        except UserError as error:
            raise UserError(
                f"{self.path}, line {number}: {error}; correct the line, or put # before it"
            ) from None

    def check(self, level_seeds: range) -> None:
        """Checks that the file has a puzzle for each level seed.

        Raises:
            UserError: see `find`.
        """
        self.find(level_seeds[0])
        possible = UNSEEN + len(self.lines) - level_seeds[0]
        if len(level_seeds) > possible:
            raise UserError(
                f"{self.path} has {self.kind} for {possible} of the {len(level_seeds)} episodes: "
                f"play at most {possible}, or give a longer file",
                "episodes",
            )
        for seed in level_seeds:
            self.find(seed)
