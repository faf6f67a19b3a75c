"""Names of levels that do not exist raise an error that helps to correct them."""

import pytest

from leapjax.domains.puzzles.countdown import problems
from leapjax.domains.puzzles.satisfiability import formulas
from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.sudoku import boards
from leapjax.errors import UserError


@pytest.mark.parametrize(
    ("domain", "name", "message"),
    [
        (formulas, "Sat20", "unknown level 'Sat20': expected Sat<variables>x<clauses> or"),
        (formulas, "sat20x91", "did you mean Sat20x91"),
        (formulas, "Sat2x3", r"level Sat2x3: variables must be in 3 .. 100, got 2"),
        (formulas, "Nae4x25", "level Nae4x25: at most 24 clauses exist, got 25"),
        (graphs, "Star3", "unknown level 'Star3': expected Star<arms>x<edges of an arm>"),
        (graphs, "star3x5", "did you mean Star3x5"),
        (graphs, "Star100x100", "has 10001 nodes: at most 1000"),
        (problems, "Countdown", "unknown level 'Countdown': expected Countdown<2 to 5 numbers>"),
        (
            problems, "Countdown6",
            "expected Countdown<2 to 5 numbers>, such as Countdown3, Countdown4",
        ),
        (problems, "countdown4", "did you mean Countdown4"),
        (
            boards, "Sudoku9",
            "expected Sudoku<4 or 9>x<clues> or Sudoku<4 or 9>x<fewest>-<most clues>",
        ),
        (boards, "Sudoku9x17", "clues must be in 22 .. 81; .* too long to draw"),
        (boards, "Sudoku9x21-30", "clues must be in 22 .. 81"),
        (boards, "Sudoku4x6-17", "clues must be in 4 .. 16"),
        (boards, "Sudoku4x8-6", "the fewest clues come first: Sudoku4x6-8"),
    ],
)  # fmt: skip
def test_unknown_levels_raise_an_error(domain, name, message):
    with pytest.raises(UserError, match=message):
        domain.find_level(name)
