"""Countdown as a `Domain`."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import check_range, check_types
from leapjax.domain import Augmentations, Domain, DomainType
from leapjax.domains.puzzles.common import demonstrate
from leapjax.domains.puzzles.countdown import problems
from leapjax.domains.puzzles.countdown.problems import (
    DIGITS,
    END,
    LARGEST_NUMBER,
    LENGTH,
    OPEN,
    SIGNS,
    TARGETS,
    CountdownAdapter,
    Level,
    Problem,
)
from leapjax.errors import UserError
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense, embed
from leapjax.types import Context

MOST = max(LARGEST_NUMBER, *TARGETS)  # of a given number or a target


@dataclasses.dataclass(frozen=True)
class Settings:
    """Countdown: augmentation.

    Attributes:
        augment: Write the solution of every training window in another order: of the operands of
            sums and products, and of equations that do not depend on each other.
    """

    augment: bool = True

    def __post_init__(self) -> None:
        check_types(self)


class ProblemTokens(Encoder):
    """A token for each given number, for the target, and for the tokens that are written.

    The given numbers have no order. The token of a number is the sum of embeddings of its value and
    its digits.

    Attributes:
        numbers: how many are given.
        width: D, of a token.
    """

    numbers: int
    width: int

    def setup(self) -> None:  # noqa: D102
        self.value = embed(MOST + 1, self.width)
        self.digits = embed(10 * DIGITS, self.width)
        self.kind = embed(2, self.width)
        self.written = dense(self.width)
        self.part = embed(LENGTH, self.width)
        self.equation = embed(self.numbers - 1, self.width)

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens `[n + 2, D]`."""
        problem = context.observation
        given, target = self.kind(jnp.arange(2))
        written = jax.nn.one_hot(problem.written, OPEN + 1).reshape(-1)
        return jnp.concatenate([
            self._embed_number(problem.numbers) + given,
            self._embed_number(problem.target[None]) + target,
            self.written(written)[None],
        ])  # fmt: skip

    def encode_positions(self, context: Context, horizon: int) -> jax.Array:
        """Encodes the place in an equation, and the equation, at each position: `[T, D]`."""
        equation, place = jnp.divmod(context.observation.place + jnp.arange(horizon), LENGTH)
        return self.part(place) + self.equation(jnp.minimum(equation, self.numbers - 2))

    def _embed_number(self, numbers: jax.Array) -> jax.Array:
        """Embeds numbers `[n]`: `[n, D]`."""
        places = jnp.arange(DIGITS)
        digits = numbers[:, None] // 10**places % 10 + 10 * places
        return self.value(numbers) + self.digits(digits).sum(1)


def make(name: str, settings: Settings) -> Domain:
    """Makes a level by name, such as Countdown4.

    Raises:
        UserError: there is no such level.
    """
    level = problems.find_level(name)
    make_adapter = functools.partial(CountdownAdapter, level)
    none = np.zeros((), np.int32)
    return Domain(
        level=name,
        make_adapter=make_adapter,
        actions=(*map(str, range(10)), *SIGNS.values(), "end"),
        max_steps=level.length,
        blank=Problem(
            np.zeros(level.numbers, np.int32), none, np.zeros(level.length, np.int32), none
        ),
        encoders={"leapjax": lambda model, sizes: ProblemTokens(level.numbers, model.width)},
        demonstrations=demonstrate(make_adapter, functools.partial(check_problems, level=level)),
        augmentations=Augmentations(
            [problems.reorder] if settings.augment else [], problems.repeat_solution
        ),
        signature={"numbers": level.numbers, "digits": DIGITS},
    )


def check_problems(states: Problem, where: str, level: Level) -> None:
    """Checks that an episode writes a solution of its problem, token by token.

    Raises:
        UserError: it does not.
    """
    check_range(f"{where}: numbers", states.numbers, 1, LARGEST_NUMBER)
    check_range(f"{where}: written tokens", states.written, 0, END)
    places = np.arange(level.length + 1)
    solution = states.written[-1]
    open_later = np.where(np.arange(level.length) < places[:, None], solution, OPEN)
    if not np.array_equal(states.place, places) or not np.array_equal(states.written, open_later):
        raise UserError(f"{where} does not write {level.length} tokens, one after the other")
    problem = states.numbers[0].tolist(), int(states.target[0])
    if not problems.is_solution(*problem, solution.tolist()):
        raise UserError(f"{where} does not solve its problem")


COUNTDOWN = DomainType(Settings, make, problems.LEVELS)
