"""Slow, obvious versions of leapjax functions, written independently."""

import numpy as np

from leapjax.domains.babyai.observations import Observation


def slow_path_lengths(
    grid, start: tuple[int, int], through_objects: bool = False
) -> dict[tuple[int, int], int]:
    """Counts the moves to reach or touch each cell: relaxes all edges until lengths are stable."""

    def can_stand(cell) -> bool:
        content = grid.get(*cell)
        if content is None or cell == start:
            return True
        if content.type == "wall":
            return False
        return content.type in ("door", "floor") or through_objects

    cells = [(x, y) for x in range(grid.width) for y in range(grid.height)]
    edges = [
        (a, b)
        for a in cells
        for b in cells
        if abs(a[0] - b[0]) + abs(a[1] - b[1]) == 1 and can_stand(a)
    ]
    lengths = dict.fromkeys(cells, np.inf)
    lengths[start] = 0
    changed = True
    while changed:
        changed = False
        for a, b in edges:
            if lengths[a] + 1 < lengths[b]:
                lengths[b] = lengths[a] + 1
                changed = True
    return {cell: int(length) for cell, length in lengths.items() if np.isfinite(length)}


def assert_same_observation(actual: Observation, expected: Observation) -> None:
    """Asserts that every field is equal; a failure names the field."""
    for field in Observation._fields:
        np.testing.assert_array_equal(
            np.asarray(getattr(actual, field)), np.asarray(getattr(expected, field)), field
        )
