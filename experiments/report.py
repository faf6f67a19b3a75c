"""Tables of the README, made from the committed rows: `python -m experiments.report`."""

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments import results
from experiments.config import PRESETS
from experiments.results import Row
from leapjax import scores
from leapjax.envs.levels import LEVELS
from leapjax.pretrained import write_text

BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"


def markdown(rows: Sequence[Row]) -> str:
    """Success rates per level: the paper's, preset `paper`, preset `leapjax`.

    A cell is the mean over seeds, the 95% interval of all their episodes together, and the
    number of seeds.
    """
    lines = [
        "| level | paper | preset `paper` | preset `leapjax` |",
        "| --- | --- | --- | --- |",
    ]
    for level in LEVELS.values():
        cells = {name: _select(rows, level.name, name) for name in PRESETS}
        lines.append(
            f"| {level.name} | {level.paper_success:.1f}% | {_cell(cells['paper'])} "
            f"| {_cell(cells['leapjax'])} |"
        )
    return "\n".join(lines)


def _select(rows: Sequence[Row], level: str, preset: str) -> list[Row]:
    return [row for row in rows if row["level"] == level and row["preset"] == preset]


def _cell(rows: Sequence[Row]) -> str:
    if not rows:
        return "-"
    successes = sum(row["successes"] for row in rows)
    episodes = sum(row["episodes"] for row in rows)
    low, high = scores.wilson_interval(successes, episodes)
    seeds = len({row["seed"] for row in rows})
    counted = f"{seeds} seed{'s' if seeds > 1 else ''}"
    return f"{100 * successes / episodes:.1f}% [{100 * low:.1f}, {100 * high:.1f}], {counted}"


def replace_section(text: str, section: str) -> str:
    """The text with what is between the markers replaced."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n\n{section}\n\n{END}{after}"


def main() -> int:
    """Rewrites the table in README.md."""
    readme = Path("README.md")
    rows = results.read(Path("results") / "babyai.jsonl")
    write_text(readme, replace_section(readme.read_text(encoding="utf-8"), markdown(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
