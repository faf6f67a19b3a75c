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
        scale = self.width**-0.5
        self.member = dense(self.width, use_bias=False, scale=scale, dtype=self.dtype)
        self.sign = dense(self.width, use_bias=False, scale=scale, dtype=self.dtype)
        self.value = embed(OPEN + 1, self.width)
        self.kind = embed(2, self.width)

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens `[clauses + variables, D]`."""
        return jnp.concatenate([self._clauses(context), self._variables(context)])

    def encode_positions(self, context: Context, horizon: int) -> jax.Array:
        """Encodes the variables that a plan assigns: `[T, D]`."""
        ahead = context.observation.variable + jnp.arange(horizon)
        return self._variables(context)[jnp.minimum(ahead, self.count - 1)]

    def _clauses(self, context: Context) -> jax.Array:
        variables, values = jnp.divmod(context.observation.literals, 2)
        names = self.names(variables)  # [clauses, 3, D]
        signed = names * (2 * values - 1)[..., None]
        kind = self.kind(jnp.zeros(1, jnp.int32))
        return self.member(names.sum(1)) + self.sign(signed.sum(1)) + kind

    def _variables(self, context: Context) -> jax.Array:
        names = self.member(self.names(jnp.arange(self.count)))
        return names + self.value(context.observation.values) + self.kind(jnp.ones(1, jnp.int32))


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
    if formulas.count_violations(states.literals[-1], states.values[-1], size.differ):
        raise UserError(f"{where} does not satisfy its formula")


SATISFIABILITY = DomainType(Settings, make, formulas.LEVELS)
