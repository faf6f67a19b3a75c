"""Satisfiability as a `Domain`."""

import dataclasses
import functools
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import Dtype

from leapjax.checks import check_at_least, check_range, check_types
from leapjax.domain import Augmentations, Domain, DomainType
from leapjax.domains.puzzles.common import demonstrate
from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.satisfiability.formulas import OPEN, Formula, FormulaAdapter
from leapjax.domains.puzzles.satisfiability.rules import rules
from leapjax.errors import UserError
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense, embed
from leapjax.types import Context


@dataclasses.dataclass(frozen=True)
class Settings:
    """Satisfiability: augmentation, and the encoder.

    Attributes:
        augment: Permute and negate the variables of every training window, which makes it a window
            of another formula.
        rounds: Rounds of messages between variables and clauses, before a plan is known and again
            in each pass.
    """

    augment: bool = True
    rounds: int = 4

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 0, "rounds", most=100)


class Messages(nn.Module):
    """One round of messages from variables to their clauses and back (Selsam et al., 2019).

    All variables share the weights, and so do all clauses: the network sees no order of them.

    Attributes:
        width: D.
        dtype: type of matrix products.
    """

    width: int
    dtype: Dtype = jnp.float32

    def setup(self) -> None:  # noqa: D102
        self.norm = nn.LayerNorm(dtype=self.dtype)
        scale = self.width**-0.5
        self.speak = dense(2 * self.width, scale=scale, dtype=self.dtype)
        self.listen = dense(self.width, scale=scale, dtype=self.dtype)

    def __call__(self, tokens: jax.Array, holds: jax.Array) -> jax.Array:
        """Returns the tokens of variables `[n, D]` after a round.

        Args:
            tokens: of variables, `[n, D]`.
            holds: `[clauses, 2 n]`, 1 where a clause holds a literal.
        """
        count = len(tokens)
        spoken = self.speak(self.norm(tokens)).reshape(2 * count, -1)  # by each literal
        heard = holds.T @ nn.gelu(holds @ spoken)  # [2 n, D]
        degree = holds.sum() / (2 * count)
        return tokens + self.listen((heard / degree).reshape(count, -1))


class Variables(NamedTuple):
    """The variables of a formula, for a plan that assigns them.

    Attributes:
        tokens: tokens `[n, D]` without a plan, the next variable first.
        holds: `[clauses, 2 n]`, see `Messages`.
    """

    tokens: jax.Array
    holds: jax.Array


class FormulaTokens(Encoder):
    """A token for each variable, from the next one on, which knows its clauses by messages.

    A plan's actions exchange messages too.

    Attributes:
        count: number of variables.
        width: D, of a token.
        rounds: of messages, before a plan is known and in each pass.
        mixed: whether the variables of a plan exchange messages.
        dtype: type of matrix products.
    """

    count: int
    width: int
    rounds: int
    mixed: bool = True
    dtype: Dtype = jnp.float32

    def setup(self) -> None:  # noqa: D102
        self.value = embed(OPEN + 1, self.width)
        self.next = embed(1, self.width)
        self.before = [Messages(self.width, self.dtype) for _ in range(self.rounds)]
        self.within = [Messages(self.width, self.dtype) for _ in range(self.rounds)]

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens `[n, D]`; the first is marked."""
        return self._encode(context).tokens.at[:1].add(self.next(jnp.zeros(1, jnp.int32)))

    def encode_positions(self, context: Context, horizon: int) -> Variables:
        """Returns the variables that a plan assigns, and those after its end."""
        del horizon
        return self._encode(context)

    def place_actions(self, tokens: jax.Array, positions: Variables) -> jax.Array:
        """Adds the variables `[T, D]`, and exchanges messages between variables of a clause."""
        count = min(len(tokens), self.count)
        last = positions.tokens[jnp.minimum(jnp.arange(len(tokens)), self.count - 1)]
        placed = tokens + last
        if not self.mixed:
            return placed
        # Variables after the plan's end take part as they are before the plan.
        whole = jnp.concatenate([placed[:count], positions.tokens[count:]])
        for messages in self.within:
            whole = messages(whole, positions.holds)
        return jnp.concatenate([whole[:count], placed[count:]])

    def _encode(self, context: Context) -> Variables:
        formula = context.observation
        # Variables are counted from the next one on, as positions of a plan are.
        literals = (formula.literals - 2 * formula.variable) % (2 * self.count)
        holds = jax.nn.one_hot(literals, 2 * self.count).sum(1)
        tokens = self.value(jnp.roll(formula.values, -formula.variable))
        for messages in self.before:
            tokens = messages(tokens, holds)
        return Variables(tokens, holds)


def make(name: str, settings: Settings) -> Domain:
    """Makes a level by name, such as Sat20x91.

    Raises:
        UserError: there is no such level.
    """
    size = formulas.find_level(name)
    make_adapter = functools.partial(FormulaAdapter, size)
    return Domain(
        level=name,
        make_adapter=make_adapter,
        actions=("false", "true", "end"),
        max_steps=size.variables,
        blank=Formula(
            np.zeros((size.clauses, 3), np.int32),
            np.zeros(size.variables, np.int32),
            np.zeros((), np.int32),
        ),
        encoders={
            "leapjax": lambda model, sizes: FormulaTokens(
                size.variables, model.width, settings.rounds, model.attention == "full", model.dtype
            )
        },
        demonstrations=demonstrate(make_adapter, functools.partial(check_formulas, size=size)),
        augmentations=Augmentations(
            [formulas.rename] if settings.augment else [], formulas.repeat_solution
        ),
        rules=rules(size.differ),
        turn=formulas.turn,
        signature={"variables": size.variables, "differ": size.differ},  # any number of clauses
    )


def check_formulas(states: Formula, where: str, size: formulas.Size) -> None:
    """Checks that an episode assigns all variables in order, and satisfies its formula.

    Raises:
        UserError: it does not.
    """
    check_range(f"{where}: literals", states.literals, 0, 2 * size.variables - 1)
    check_range(f"{where}: values", states.values, 0, OPEN)
    in_order = np.array_equal(states.variable, np.arange(size.variables + 1))
    if not in_order or states.values[-1].max() == OPEN:
        raise UserError(f"{where} does not assign the {size.variables} variables in order")
    if formulas.find_violated(states.literals[-1], states.values[-1], size.differ).any():
        raise UserError(f"{where} does not satisfy its formula")


SATISFIABILITY = DomainType(Settings, make, formulas.LEVELS)
