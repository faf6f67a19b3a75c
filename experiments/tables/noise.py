"""The table of noise: success of each method on validation levels, by temperature."""

from collections.abc import Sequence

from experiments.noise import EPISODES, TEMPERATURES, make_noise
from experiments.tables.babyai import COMPARED
from experiments.tables.cells import compute_mean_rate, make_table
from experiments.tables.settings import Setting, select
from leapjax.domains.babyai.levels import LEVELS
from leapjax.methods import find_method
from leapjax.running.results import Row

METHODS = COMPARED[1:]  # random actions have no temperature
PLAYED = {"validation": True, "episodes": EPISODES}
SETTINGS = {
    (method, each): Setting("paper", method, PLAYED).searching(
        **make_noise(each, find_method(method).planner)
    )
    for method in METHODS
    for each in TEMPERATURES
}


def is_used(row: Row) -> bool:
    """Tells whether a row is in the table."""
    return any(setting.has(row) for setting in SETTINGS.values())


def compare_temperatures(rows: Sequence[Row]) -> str:
    """Tabulates the success of each method at each temperature, with preset `paper`."""
    found = select(rows, LEVELS, SETTINGS)
    lines = []
    for level in LEVELS:
        for method in METHODS:
            cells = [found[level, (method, each)] for each in TEMPERATURES]
            if any(cells):
                rates = (f"{compute_mean_rate(of):.1f}%" if of else "-" for of in cells)
                lines.append([level, method, *rates])
    return make_table(" | ".join(["level", "method", *map("{:g}".format, TEMPERATURES)]), lines)
