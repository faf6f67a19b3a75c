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
from leapjax.models.transformer import dense, embed
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
    """A token for each clause and for each variable.

    A clause's token is a sum over its literals, so their order means nothing. `encode_positions`
    gives each action of a plan the token of its variable.

    Attributes:
        count: number of variables.
        width: D, of a token.
        dtype: type of matrix products.
    """

    count: int
    width: int
    dtype: Dtype = jnp.float32

    def setup(self) -> None:  # noqa: D102
        # Large names stay nearly orthogonal while attention learns to compare them.
        self.names = nn.Embed(self.count, self.width, embedding_init=nn.initializers.normal(1.0))
        make = functools.partial(
            dense, self.width, use_bias=False, scale=self.width**-0.5, dtype=self.dtype
        )
        self.member, self.sign, self.about, self.toward = make(), make(), make(), make()
        self.value = embed(OPEN + 1, self.width)
        self.kind = embed(2, self.width)

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens `[clauses, D]`."""
        return self._encode(context)[0]

    def encode_positions(self, context: Context, horizon: int) -> jax.Array:
        """Encodes the variables that a plan assigns: `[T, D]`."""
        ahead = context.observation.variable + jnp.arange(horizon)
        return self._encode(context)[1][jnp.minimum(ahead, self.count - 1)]

    def _encode(self, context: Context) -> tuple[jax.Array, jax.Array]:
        """Encodes clauses `[clauses, D]`, and variables `[count, D]` with their clauses."""
        formula = context.observation
        variables, values = jnp.divmod(formula.literals, 2)
        holds = jax.nn.one_hot(variables, self.count)  # [clauses, 3, count]
        signed = (holds * (2 * values - 1)[..., None]).sum(1)
        holds = holds.sum(1)
        names = self.names(jnp.arange(self.count))
        known = self.value(formula.values)
        clauses = holds @ (self.member(names) + known) + signed @ self.sign(names)
        clauses = clauses + self.kind(jnp.zeros(1, jnp.int32))
        seen = nn.gelu(clauses)
        degree = (1 + holds.sum(0))[:, None]
        told = holds.T @ self.about(seen) + signed.T @ self.toward(seen)
        own = self.member(names) + known + told / jnp.sqrt(degree)
        return clauses, own + self.kind(jnp.ones(1, jnp.int32))


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
                size.variables, model.width, model.dtype
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
