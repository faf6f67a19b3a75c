"""Satisfiability: formulas with a solution, drawn from a seed.

A formula has clauses of three literals. A plan assigns the variables in order: action number t of
an episode is the value of variable t. Two kinds of level exist:

    Sat20x91   each of the 91 clauses holds a true literal
    Nae20x42   each of the 42 clauses holds a true and a false literal (not all equal)

Formulas are hardest to solve where half of all random formulas have a solution. Of 20 variables
that takes about 91 clauses, as in SATLIB's uf20-91. Not-all-equal clauses forbid two patterns
instead of one, so about 42 are enough: 2.1 a variable (Achlioptas et al., 2001).
"""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import check_seed
from leapjax.domains.puzzles.common import PuzzleAdapter, repeat, rewrite, turn_whole
from leapjax.domains.puzzles.names import read_numbers
from leapjax.errors import UserError
from leapjax.types import Array, Context, Demonstration, Turned, Window

LEVELS = ("Sat20x91", "Nae20x42")
LITERALS = 3  # in a clause
MOST_VARIABLES = 100
OPEN = 2  # a variable without a value


class Size(NamedTuple):
    """A level.

    Attributes:
        variables: of its formulas.
        clauses: of its formulas.
        differ: whether each clause also needs a false literal.
    """

    variables: int
    clauses: int
    differ: bool

    @property
    def patterns(self) -> int:
        """Number of ways to set three literals so that they satisfy a clause."""
        return 2**LITERALS - 1 - self.differ


class Formula(NamedTuple):
    """An observation: a formula, and the values of its variables so far.

    Literal `2 v + a` is true if variable v has the value a: 0 is false, 1 is true.

    Attributes:
        literals: `[clauses, 3]` int32, of three different variables in each clause.
        values: `[variables]` int32: 0, 1, or OPEN.
        variable: `[]` int32, the variable to assign next; `variables` after the last.
    """

    literals: Array
    values: Array
    variable: Array


def find_level(name: str) -> Size:
    """Reads a level's name, such as Sat20x91: 20 variables and 91 clauses.

    Raises:
        UserError: the level does not exist.
    """
    pattern = r"(?:Sat|Nae)([1-9]\d{0,2})x([1-9]\d{0,5})"
    expected = "Sat<variables>x<clauses> or Nae<variables>x<clauses>"
    variables, clauses = read_numbers(name, pattern, expected, LEVELS)
    size = Size(variables, clauses, differ=name.startswith("Nae"))
    if not LITERALS <= size.variables <= MOST_VARIABLES:
        raise UserError(
            f"level {name}: variables must be in {LITERALS} .. {MOST_VARIABLES}, "
            f"got {size.variables}"
        )
    most = len(_list_triples(size.variables)) * size.patterns
    if size.clauses > most:
        raise UserError(f"level {name}: at most {most} clauses exist, got {size.clauses}")
    return size


@functools.cache
def _list_triples(variables: int) -> np.ndarray:
    """Lists the sets of three variables: `[sets, 3]` int32."""
    return np.array(list(itertools.combinations(range(variables), LITERALS)), np.int32)


def draw(size: Size, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws the literals `[clauses, 3]` of a seed's formula, and one solution `[variables]`.

    It draws the solution first, then different clauses that the solution satisfies. Given the
    formula, every solution is then equally likely to be this one, as all of them satisfy equally
    many clauses.
    """
    rng = np.random.default_rng(check_seed(seed))
    solution = rng.integers(2, size=size.variables, dtype=np.int32)
    triples = _list_triples(size.variables)
    codes = rng.choice(len(triples) * size.patterns, size.clauses, replace=False)
    triple, pattern = np.divmod(codes, size.patterns)
    true = (1 + pattern[:, None] >> np.arange(LITERALS)) & 1  # at least one; not all if they differ
    variables = triples[triple]
    literals = 2 * variables + (solution[variables] ^ 1 ^ true)
    return rng.permuted(literals, axis=1).astype(np.int32), solution


def find_violated(literals: Array, values: Array, differ: bool) -> Array:
    """Finds the clauses `[clauses]` that values violate, whatever the open variables become.

    Args:
        literals: `[clauses, 3]`.
        values: `[variables]`: 0, 1, or any other number for an open variable.
        differ: whether each clause also needs a false literal.
    """
    found, wanted = values[literals // 2], literals % 2
    violated = (found == 1 - wanted).all(axis=-1)
    return violated | (found == wanted).all(axis=-1) if differ else violated


class FormulaAdapter(PuzzleAdapter[Formula]):
    """A formula as the rollout sees it: actions are values of one variable after the other.

    A value that violates a clause ends the episode; the last value ends it with success.
    """

    def __init__(self, size: Size) -> None:
        self.size = size
        self.num_actions = 3

    def draw(self, seed: int) -> tuple[Formula, np.ndarray]:
        """Draws the formula of a seed."""
        literals, solution = draw(self.size, seed)
        return Formula(literals, np.full_like(solution, OPEN), np.int32(0)), solution

    def move(self, formula: Formula, action: int) -> tuple[Formula, bool | None]:
        """Assigns a variable."""
        values = formula.values.copy()
        values[formula.variable] = action
        after = Formula(formula.literals, values, np.int32(formula.variable + 1))
        if find_violated(after.literals, values, self.size.differ).any():
            return after, False
        return after, True if after.variable == self.size.variables else None


def repeat_solution(demonstration: Demonstration) -> np.ndarray:
    """Returns the solution for every step, for augmentation: `[n, variables]` int8."""
    repeated: np.ndarray = repeat(
        demonstration.observations.values[-1].astype(np.int8), demonstration
    )
    return repeated


def rename(key: jax.Array, window: Window) -> Window:
    """Turns a window into a window of another formula, with new variables and signs.

    It permutes the variables and negates a random half of them, in clauses and solution alike. The
    new variables are assigned in order too, up to the same number of them.
    """
    solution = window.extras.astype(jnp.int32)
    count = solution.shape[0]
    places, negated = _draw_symmetry(key, count)
    solution = jnp.zeros_like(solution).at[places].set(solution ^ negated)
    formula = window.context.observation
    literals = _rename_literals(formula.literals, places, negated)

    def observe(variable: jax.Array) -> Formula:
        known = jnp.arange(count) < variable
        return Formula(literals, jnp.where(known, solution, OPEN), variable)

    return rewrite(window, lambda state: state.variable, solution, observe, end=2)


def turn(key: jax.Array, context: Context, horizon: int) -> Turned:
    """Permutes and negates the variables of a formula, for plans that assign all of them."""
    formula = context.observation
    count = formula.values.shape[0]

    def draw() -> tuple[Formula, jax.Array, jax.Array]:
        places, negated = _draw_symmetry(key, count)
        literals = _rename_literals(formula.literals, places, negated)
        order = jnp.argsort(places)  # `places` says where a variable goes
        return formula._replace(literals=literals), order, jnp.arange(2) ^ negated[:, None]

    return turn_whole(context, count, formula.variable == 0, horizon, 3, draw)


def _draw_symmetry(key: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Draws a permutation of `count` variables, and which of them to negate.

    Returns:
        The new place `[count]` of each variable, and `[count]` 1 for each negated one, else 0.
    """
    order_key, sign_key = jax.random.split(key)
    places = jax.random.permutation(order_key, count)
    return places, jax.random.randint(sign_key, (count,), 0, 2)


def _rename_literals(literals: Array, places: jax.Array, negated: jax.Array) -> jax.Array:
    """Returns literals, of any shape, after the variables moved to `places` and changed signs."""
    variables, values = jnp.divmod(literals, 2)
    return 2 * places[variables] + (values ^ negated[variables])
