"""Two classical solvers of satisfiability, to read a learned search beside: WalkSAT and DPLL."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from rich.table import Table

from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.satisfiability.formulas import OPEN, Size

NOISE = 0.5  # probability of a random flip, as in Selman et al. (1994)
FLIPS = 1000  # at most


class Solved(NamedTuple):
    """The result of a solver.

    Attributes:
        values: `[variables]`; `None` if the solver found no solution.
        steps: flips of WalkSAT, or assumptions of DPLL.
    """

    values: np.ndarray | None
    steps: int


def walk(literals: np.ndarray, size: Size, seed: int, flips: int = FLIPS) -> Solved:
    """Walks from a random assignment: it flips a variable of a violated clause, drawn at random.

    With probability NOISE that is any of the three variables, otherwise the one whose flip leaves
    the fewest clauses violated (WalkSAT; Selman et al., 1994).
    """
    rng = np.random.default_rng((seed, 1))  # the formula of a seed starts with its solution
    values = rng.integers(2, size=size.variables)
    for flip in range(flips + 1):
        violated = np.flatnonzero(_find_violated(literals, values, size))
        if not len(violated):
            return Solved(values, flip)
        variables = literals[rng.choice(violated)] // 2
        if rng.random() < NOISE:
            chosen = rng.choice(variables)
        else:
            tried = np.repeat(values[None], len(variables), axis=0)
            tried[np.arange(len(variables)), variables] ^= 1
            counts = [_find_violated(literals, each, size).sum() for each in tried]
            chosen = variables[np.argmin(counts)]
        values[chosen] ^= 1
    return Solved(None, flips)


def backtrack(literals: np.ndarray, size: Size) -> Solved:
    """Assigns variables and takes back what fails (Davis, Logemann and Loveland, 1962).

    It first assigns whatever a clause leaves no choice for (unit propagation), then assumes a value
    of the variable in most of the shortest open clauses.
    """
    steps = 0

    def search(values: np.ndarray) -> np.ndarray | None:
        nonlocal steps
        while True:
            if _find_violated(literals, values, size).any():
                return None
            forced, open_clauses = _find_forced(literals, values, size)
            if not len(forced):
                break
            values[forced // 2] = forced % 2  # opposite literals violate a clause in the next round
        if not open_clauses.any():
            return np.where(values == OPEN, 0, values)
        found = values[literals // 2]
        lengths = (found == OPEN).sum(axis=1)
        shortest = open_clauses & (lengths == lengths[open_clauses].min())
        choices = literals[shortest][found[shortest] == OPEN]
        literal = np.bincount(choices).argmax()
        for value in (literal % 2, 1 - literal % 2):
            steps += 1
            assumed = values.copy()
            assumed[literal // 2] = value
            solution = search(assumed)
            if solution is not None:
                return solution
        return None

    values = search(np.full(size.variables, OPEN))
    return Solved(values, steps)


def compare(level: str, seeds: Sequence[int]) -> Table:
    """Solves the formulas of some level seeds with each solver: success, steps and time."""
    size = formulas.find_level(level)
    drawn = [formulas.draw(size, seed)[0] for seed in seeds]
    solvers: dict[str, Callable[[np.ndarray, int], Solved]] = {
        f"WalkSAT, at most {FLIPS} flips": lambda literals, seed: walk(literals, size, seed),
        "DPLL": lambda literals, seed: backtrack(literals, size),
    }
    table = Table("solver", "success", "flips or assumptions", "milliseconds a formula")
    for name, solve in solvers.items():
        begun = time.perf_counter()
        found = [solve(literals, seed) for literals, seed in zip(drawn, seeds, strict=True)]
        seconds = time.perf_counter() - begun
        success = np.mean([each.values is not None for each in found])
        steps = np.mean([each.steps for each in found])
        table.add_row(name, f"{success:.1%}", f"{steps:.1f}", f"{1000 * seconds / len(found):.1f}")
    return table


def _find_violated(literals: np.ndarray, values: np.ndarray, size: Size) -> np.ndarray:
    """Finds the clauses `[clauses]` that values violate."""
    return formulas.find_violated(literals, values, size.differ)


def _find_forced(
    literals: np.ndarray, values: np.ndarray, size: Size
) -> tuple[np.ndarray, np.ndarray]:
    """Finds the literals that clauses leave no choice for, and the clauses that are still open."""
    found, wanted = values[literals // 2], literals % 2
    open_places = found == OPEN
    satisfied = (found == wanted).any(axis=1)
    if size.differ:
        satisfied &= (found == 1 - wanted).any(axis=1)
    unit = ~satisfied & (open_places.sum(axis=1) == 1)
    forced = literals[unit][open_places[unit]]
    if size.differ:  # the two known literals are equal: the third becomes their opposite
        forced = forced ^ (found == wanted)[unit].any(axis=1)
    return forced, ~satisfied
