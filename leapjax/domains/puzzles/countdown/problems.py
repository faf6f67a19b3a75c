"""Countdown: reach a target with the four operations, using each given number exactly once.

The ranges follow 'Stream of Search' (Gandhi et al., 2024), as 'Beyond Autoregression' (Ye et al.,
2025) does. Numbers are in 1 .. 99, targets in 10 .. 100. Results are integers and never negative.
A solution of n numbers has n - 1 equations `a op b = c`.
"""

import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import check_seed
from leapjax.data.seeds import TRAINING_START, VALIDATION_START
from leapjax.domains.puzzles.common import PuzzleAdapter, repeat, rewrite
from leapjax.domains.puzzles.names import read_numbers
from leapjax.types import Array, Demonstration, Window

LEVELS = ("Countdown3", "Countdown4")
LARGEST_NUMBER = 99
TARGETS = range(10, 101)
# Targets that only test or validation episodes have, by their remainder: every eleventh target, so
# their last digits differ.
MODULUS, TEST, VALIDATION = 11, 5, 8

# Of the pairs of numbers and target with a solution, 99% of Countdown3 and 95% of Countdown4 have
# one without larger numbers.
LARGEST = 999
DIGITS = 3  # of each number, zeros first

# Tokens: 0 .. 9 are digits. A token for each number would make plans shorter, but a network then
# learns each result by itself, and few steps of training teach it no arithmetic.
PLUS, MINUS, TIMES, DIVIDE, END = range(10, 15)
OPEN = END  # in observations: not written yet
SIGNS = {PLUS: "+", MINUS: "-", TIMES: "*", DIVIDE: "/"}
A, SIGN, B, RESULT = PARTS = (
    slice(0, DIGITS), slice(DIGITS, DIGITS + 1), slice(DIGITS + 1, 2 * DIGITS + 1),
    slice(2 * DIGITS + 1, 3 * DIGITS + 1),
)  # fmt: skip
LENGTH = RESULT.stop  # tokens of an equation, without its "="

Equation = tuple[int, int, int, int]  # a, operation, b, result


class Level(NamedTuple):
    """A level.

    Attributes:
        numbers: how many numbers are given.
    """

    numbers: int

    @property
    def length(self) -> int:
        """Number of tokens of a solution."""
        return LENGTH * (self.numbers - 1)


class Problem(NamedTuple):
    """An observation: a problem, and the tokens of its solution so far.

    Attributes:
        numbers: `[n]` int32, the given numbers.
        target: `[]` int32.
        written: `[10 (n - 1)]` int32 tokens; `OPEN` where no token is written yet.
        place: `[]` int32, the number of written tokens.
    """

    numbers: Array
    target: Array
    written: Array
    place: Array


def find_level(name: str) -> Level:
    """Reads a level's name, such as Countdown4: problems with four numbers.

    Raises:
        UserError: the level does not exist.
    """
    return Level(*read_numbers(name, r"Countdown([2-5])", "Countdown<2 to 5 numbers>", LEVELS))


def list_targets(seed: int) -> list[int]:
    """Lists the targets of a level seed: training, validation and test have different targets."""
    held_out = (TEST, VALIDATION)
    if seed >= TRAINING_START:
        return [target for target in TARGETS if target % MODULUS not in held_out]
    kept = VALIDATION if seed >= VALIDATION_START else TEST
    return [target for target in TARGETS if target % MODULUS == kept]


def compute(a: int, operation: int, b: int) -> int | None:
    """Returns the result of an operation; `None` if it is no number of a solution."""
    if operation == PLUS:
        result = a + b
    elif operation == MINUS:
        result = a - b
    elif operation == TIMES:
        result = a * b
    else:
        result = a // b if b and a % b == 0 else -1
    return result if 0 <= result <= LARGEST else None


def write_equations(equations: Sequence[Equation]) -> np.ndarray:
    """Writes equations as tokens `[10 k]`."""
    powers = 10 ** np.arange(DIGITS)[::-1]
    rows = np.array(equations, np.int32)
    a, b, result = (rows[:, part, None] // powers % 10 for part in (0, 2, 3))
    return np.concatenate([a, rows[:, 1:2], b, result], axis=1).reshape(-1).astype(np.int32)


def read_equations(tokens: Sequence[int]) -> list[list[int]] | None:
    """Reads the equations of tokens, the last perhaps unfinished: lists of a, operation, b, result.

    Returns `None` if a token is a digit in place of an operation, or the reverse.
    """
    equations = []
    for begun in range(0, len(tokens), LENGTH):
        equation, parts = tokens[begun : begun + LENGTH], []
        for part in PARTS:
            found = equation[part]
            wanted = SIGNS if part == SIGN else range(10)
            if any(token not in wanted for token in found):
                return None
            if len(found) == part.stop - part.start:
                parts.append(found[0] if part == SIGN else int("".join(map(str, found))))
        equations.append(parts)
    return equations


def can_continue(numbers: Sequence[int], tokens: Sequence[int]) -> bool:
    """Tells whether tokens begin a solution: all equations are legal, whatever they reach.

    Args:
        numbers: the given numbers.
        tokens: of an unfinished or a finished solution.
    """
    left, equations = list(numbers), read_equations(tokens)
    if equations is None:
        return False
    for equation in equations:
        for operand in equation[:3:2]:
            if operand not in left:
                return False
            left.remove(operand)
        if len(equation) == len(PARTS):
            a, operation, b, result = equation
            if compute(a, operation, b) != result:
                return False
            left.append(result)
    return True


def is_solution(numbers: Sequence[int], target: int, tokens: Sequence[int]) -> bool:
    """Tells whether tokens are a complete solution; a problem may have several."""
    if len(tokens) != LENGTH * (len(numbers) - 1) or not can_continue(numbers, tokens):
        return False
    equations = read_equations(tokens)
    return equations is not None and equations[-1][-1] == target


class Last(NamedTuple):
    """The last operation that makes a number, of two numbers that disjoint subsets make.

    Attributes:
        first: subset that makes a, as bits.
        a: larger operand.
        operation: token.
        second: subset that makes b, as bits.
        b: smaller operand.
    """

    first: int
    a: int
    operation: int
    second: int
    b: int


def solve(numbers: Sequence[int], target: int) -> list[Equation] | None:
    """Finds a solution by exact search; `None` if each needs a number above `LARGEST`.

    The solution is the same for the same numbers in any order. The larger operand comes first.
    """
    ordered = sorted(numbers, reverse=True)
    every = (1 << len(ordered)) - 1
    # By subset of the given numbers, as bits: the numbers that it makes; `None` if given.
    made: dict[int, dict[int, Last | None]] = {
        1 << place: {number: None} for place, number in enumerate(ordered)
    }
    for subset in range(1, every + 1):
        if subset not in made:
            made[subset] = _combine(made, subset)

    def list_equations(subset: int, number: int) -> Iterator[Equation]:
        last = made[subset][number]
        if last is not None:
            yield from list_equations(last.first, last.a)
            yield from list_equations(last.second, last.b)
            yield last.a, last.operation, last.b, number

    return list(list_equations(every, target)) if target in made[every] else None


def _combine(made: Mapping[int, Mapping[int, Last | None]], subset: int) -> dict[int, Last | None]:
    """Finds the numbers that a subset makes, from the numbers that smaller subsets make."""
    found: dict[int, Last | None] = {}
    first = subset & (subset - 1)
    while first:
        second = subset ^ first
        for a, b in itertools.product(made[first], made[second]):
            if a < b or (a == b and first < second):  # the other split has this pair in order
                continue
            quotient = a // b if b and a % b == 0 else LARGEST + 1
            results = (PLUS, a + b), (MINUS, a - b), (TIMES, a * b), (DIVIDE, quotient)
            for operation, result in results:
                if result <= LARGEST and result not in found:
                    found[result] = Last(first, a, operation, second, b)
        first = (first - 1) & subset
    return found


# All planners are measured on the same problems. `typed`, as 5.0 is not the seed 5.
@functools.lru_cache(maxsize=10_000, typed=True)
def draw(level: Level, seed: int) -> tuple[Problem, np.ndarray]:
    """Draws the problem of a seed, and the tokens of a solution.

    It draws the target first, then numbers until there is a solution.
    """
    rng = np.random.default_rng(check_seed(seed))
    target = int(rng.choice(list_targets(seed)))
    while True:
        numbers = rng.integers(1, LARGEST_NUMBER, level.numbers, dtype=np.int32, endpoint=True)
        equations = solve(numbers.tolist(), target)
        if equations is not None:
            blank = np.full(level.length, OPEN, np.int32)
            solution = write_equations(equations)
            for array in (numbers, blank, solution):
                array.setflags(write=False)  # the cache shares them
            return Problem(numbers, np.int32(target), blank, np.int32(0)), solution


class CountdownAdapter(PuzzleAdapter[Problem]):
    """A problem as the rollout sees it: actions are the tokens of the solution.

    A token that makes an equation illegal ends the episode; the last token of any solution ends it
    with success.
    """

    def __init__(self, level: Level) -> None:
        self.level = level
        self.num_actions = END + 1

    def draw(self, seed: int) -> tuple[Problem, np.ndarray]:
        """Draws the problem of a seed."""
        return draw(self.level, seed)

    def move(self, problem: Problem, action: int) -> tuple[Problem, bool | None]:
        """Writes a token if it is legal."""
        written, place = problem.written.copy(), int(problem.place)
        written[place] = action
        numbers, tokens = problem.numbers.tolist(), written[: place + 1].tolist()
        if not can_continue(numbers, tokens):
            return problem, False
        after = problem._replace(written=written, place=np.int32(place + 1))
        if len(tokens) < self.level.length:
            return after, None
        return after, is_solution(numbers, int(problem.target), tokens)


def repeat_solution(demonstration: Demonstration) -> np.ndarray:
    """Returns the solution for every step, for augmentation: `[n, T]`."""
    return repeat(demonstration.observations.written[-1], demonstration)


def reorder(key: jax.Array, window: Window) -> Window:
    """Writes a window's solution in another order.

    It exchanges the operands of random sums and products, and random equations with the next one
    where that does not use their result.
    """
    operand_key, order_key = jax.random.split(key)
    problem = window.context.observation
    equations = window.extras.astype(jnp.int32).reshape(-1, LENGTH)
    commutes = ((equations[:, SIGN] == PLUS) | (equations[:, SIGN] == TIMES))[:, 0]
    exchanged = commutes & jax.random.bernoulli(operand_key, shape=commutes.shape)
    turned = jnp.concatenate([equations[:, part] for part in (B, SIGN, A, RESULT)], axis=1)
    equations = jnp.where(exchanged[:, None], turned, equations)
    moved = jax.random.bernoulli(order_key, shape=commutes.shape)
    for place in range(len(commutes) - 1):
        pair = equations[place : place + 2]
        first, second = pair
        uses = (second[A] == first[RESULT]).all() | (second[B] == first[RESULT]).all()
        pair = jnp.where(moved[place] & ~uses, pair[::-1], pair)
        equations = equations.at[place : place + 2].set(pair)
    solution = equations.reshape(-1)

    def observe(place: jax.Array) -> Problem:
        written = jnp.where(jnp.arange(len(solution)) < place, solution, OPEN)
        return problem._replace(written=written, place=place)

    return rewrite(window, lambda state: state.place, solution, observe, END)
