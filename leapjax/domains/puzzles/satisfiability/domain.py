"""Satisfiability as a `Domain`."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import Dtype

from leapjax.checks import check_range, check_types
from leapjax.data.solved import collect_solved
from leapjax.domain import Augmentations, Demonstrations, Domain, DomainType
from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.satisfiability.formulas import OPEN, Formula, FormulaAdapter
from leapjax.domains.puzzles.satisfiability.rules import rules
from leapjax.errors import UserError
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import WEIGHT_SCALE, dense, embed
from leapjax.types import Context


@dataclasses.dataclass(frozen=True)
class Settings:
    """Satisfiability: augmentation.

    Attributes:
        augment: Permute and negate the variables of every training window, which makes it a window
            of another formula.
    """

    augment: bool = True

    def __post_init__(self) -> None:
        check_types(self)


class FormulaTokens(Encoder):
    """A token for each clause, and for each action of a plan the token of its variable.

    Each variable has a name, a vector that is part of the tokens of its clauses. Attention then
    finds the clauses of a variable by comparing names. Name t is that of variable `variable + t`,
    which action t of a plan assigns; names after the last variable are those of the first.

    Attributes:
        count: number of variables.
        width: D, of a token.
        mixed: whether the token of an action also holds all values of the plan.
        dtype: type of matrix products.
    """

    count: int
    width: int
    mixed: bool = True
    dtype: Dtype = jnp.float32

    def setup(self) -> None:  # noqa: D102
        # Attention learns to compare names sooner if they are orthogonal.
        init = nn.initializers.orthogonal(WEIGHT_SCALE * self.width**0.5)
        self.names = self.param("names", init, (2 * self.count, self.width))
        self.value = embed(OPEN + 1, self.width)
        self.norm = nn.LayerNorm()
        self.expand = dense(self.width, scale=self.width**-0.5, dtype=self.dtype)
        self.about = dense(self.width, use_bias=False, dtype=self.dtype)
        self.toward = dense(self.width, use_bias=False, dtype=self.dtype)
        self.amount = dense(2, scale=self.width**-0.5 / WEIGHT_SCALE, dtype=self.dtype)

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens `[clauses, D]`."""
        return self._encode(context)[0]

    def encode_positions(self, context: Context, horizon: int) -> jax.Array:
        """Encodes the variables that a plan assigns, with their clauses: `[T, D]`."""
        return self._encode(context)[1][jnp.minimum(jnp.arange(horizon), self.count - 1)]

    def mix_actions(self, tokens: jax.Array) -> jax.Array:
        """Adds to the token of each action the values of all variables, `[T, D]`.

        A clause holds the same names, so one layer finds the clauses that the plan leaves
        unsatisfied. Otherwise layers must first learn to collect the values.
        """
        if not self.mixed:
            return tokens
        amounts = self.amount(tokens)[: self.count]  # [T, 2]
        member, sign = (names[: len(amounts)] for names in jnp.split(self.names, 2))
        values = amounts[:, 0] @ member + amounts[:, 1] @ sign
        return tokens + values / jnp.sqrt(self.count)

    def _encode(self, context: Context) -> tuple[jax.Array, jax.Array]:
        """Encodes clauses `[clauses, D]`, and variables `[count, D]` from the next one on."""
        formula = context.observation
        variables, values = jnp.divmod(formula.literals, 2)
        places = (variables - formula.variable) % self.count
        each = jax.nn.one_hot(places, self.count)  # [clauses, 3, count]
        holds, signed = each.sum(1), (each * (2 * values - 1)[..., None]).sum(1)
        member, sign = jnp.split(self.names, 2)
        known = self.value(jnp.roll(formula.values, -formula.variable))
        clauses = holds @ (member + known) + signed @ sign
        seen = nn.gelu(self.expand(self.norm(clauses)))
        told = holds.T @ self.about(seen) + signed.T @ self.toward(seen)
        return clauses, member + known + told / jnp.sqrt(1 + holds.sum(0))[:, None]


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
            "leapjax": lambda model, context: FormulaTokens(
                size.variables, model.width, model.attention == "full", model.dtype
            )
        },
        demonstrations=Demonstrations(
            functools.partial(collect_solved, make_adapter, lambda adapter: adapter.solution),
            check=functools.partial(check_formulas, size=size),
        ),
        augmentations=Augmentations(
            [formulas.rename] if settings.augment else [], formulas.repeat_solution
        ),
        rules=rules(size.differ),
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
