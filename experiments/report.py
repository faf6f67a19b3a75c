"""Tables in the documents, made from the committed rows: `python -m experiments.report`.

What is in each is a function of rows in `experiments/tables/`.
"""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.common import figures
from experiments.tables import analyses, atari, babyai, measured, puzzles, speed
from experiments.tables.analyses import ANALYSES
from experiments.tables.measured import MEASURED
from leapjax.errors import UserError
from leapjax.files import read_text, write_text
from leapjax.running import results, shell, startup
from leapjax.running.results import Row

DOCUMENTS = ("README.md", "docs/performance.md", "docs/reproduction.md")
PUZZLES = ("stars", "sudoku")  # experiments, named as their domains
EXPERIMENTS = ("babyai", "atari", *PUZZLES, *ANALYSES)  # that have rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrites every table here; the exit code."""
    given = shell.read_arguments(arguments)
    about = "Rewrites the tables in the documents, and the figures, from results/ in this folder."
    command = startup.format_command("experiments.report")
    argparse.ArgumentParser(command, description=about).parse_args(given)
    return shell.run_program("experiments.report", given, rewrite)


def rewrite() -> None:
    """Rewrites every table, and draws every figure of rows, here."""
    for path, text in documents(Path()).items():
        write_text(path, text)
    rows, folder = rows_of(Path(), "babyai"), Path("docs")
    by_passes = puzzles.success_by_passes(rows_of(Path(), *PUZZLES))
    figures.iterations_by_level(babyai.success_by_iterations(rows), folder / "iterations.png")
    figures.iterations_by_level(by_passes, folder / "searches.png")
    figures.methods_by_level(
        babyai.success_by_method(rows), babyai.COMPARED, folder / "methods.png"
    )
    figures.intervals(babyai.aggregates(rows), folder / "aggregate.png")
    figures.landscape(_measured(Path(), "landscape"), folder / "landscape.png")
    figures.energy_against_reward(_measured(Path(), "atari-energy"), folder / "atari-energy.png")


def rows_of(root: Path, *names: str) -> list[Row]:
    """Reads the rows of some experiments, each with its episodes where they are recorded.

    Raises:
        UserError: a row that tables could not be made from, or of another experiment.
    """
    found = []
    for name in names:
        path = root / "results" / f"{name}.jsonl"
        schema = results.OF_ANALYSIS if name in ANALYSES else results.OF_EXPERIMENT
        recorded = results.read_episodes(path)
        for row in results.read(path, schema):
            if row["experiment"] != name:
                raise UserError(
                    f"{path}: a row of {row['experiment'][:40]}, hash {row['hash'][:20]}: move it "
                    "to the file of its experiment"
                )
            found.append({**row, "recorded": recorded.get(row["hash"])})
    return found


def _measured(root: Path, name: str) -> Any:
    return measured.read(root / "results" / f"{name}.json")


def rows_by_source(root: Path) -> dict[str, Any]:
    """What tables are made from: rows by experiment, and what was measured, by file."""
    rows: dict[str, Any] = {name: rows_of(root, name) for name in EXPERIMENTS}
    rows |= {name: _measured(root, name) for name in MEASURED}
    return rows | {"puzzles": [row for name in PUZZLES for row in rows[name]]}


def documents(root: Path) -> dict[Path, str]:
    """What each document with tables should say, given the rows."""
    rows = rows_by_source(root)
    sections = sections_of(rows)
    written = {}
    for path in (root / name for name in DOCUMENTS):
        text = read_text(path)
        for name, (make, source) in sections.items():
            if f"<!-- {name}: begin -->" in text:
                text = replace_section(text, name, make(rows[source]))
        written[path] = text
    return written


def sections_of(rows: Mapping[str, Any]) -> dict[str, tuple[Callable[[Any], str], str]]:
    """By name of the section, what makes its table, and the source of the rows that it takes.

    Args:
        rows: by source: some tables take a second one.
    """
    properties = ANALYSES["properties"]
    return {
        "results": (functools.partial(babyai.success, settings=babyai.PRESETS), "babyai"),
        "iterations": (babyai.iterations, "babyai"),
        "methods": (babyai.methods, "babyai"),
        "price": (functools.partial(babyai.price, measured=rows["methods"]), "babyai"),
        "search-pays": (puzzles.searches, "puzzles"),
        "arms": (puzzles.arms, "puzzles"),
        "atari": (functools.partial(atari.played, data=rows["atari-data"]), "atari"),
        "atari-data": (atari.data, "atari-data"),
        "atari-energy": (atari.energy, "atari-energy"),
        "atari-decisions": (atari.decisions, "atari-cost"),
        "atari-training": (speed.training, "atari-training"),
        "speed": (speed.speed, "planning"),
        "planning": (speed.planning, "planning"),
        "training": (speed.training, "training"),
        "parts": (speed.parts, "training"),
        "quality": (speed.quality, "quality"),
        "landscape": (analyses.landscape, "landscape"),
        "table-3": (
            functools.partial(
                analyses.compared,
                properties,
                ways=analyses.AS_THE_PAPER,
                cases=analyses.OF_THE_PAPER,
            ),
            "properties",
        ),
        "exploring": (
            functools.partial(analyses.compared, properties, ways=analyses.EXPLORING),
            "properties",
        ),
        "two-constraints": (
            functools.partial(analyses.compared, properties, cases=analyses.ERRANDS),
            "properties",
        ),
        **{
            name: (functools.partial(analyses.compared, each), name)
            for name, each in ANALYSES.items()
            if name != "properties"
        },
    }


def replace_section(text: str, name: str, section: str) -> str:
    """The text with what is between the two markers of that name replaced."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n\n{section}\n\n{end}{after}"


def is_used(row: Row) -> bool:
    """Whether a row is in a table; one that is in none is stale."""
    if row.get("experiment") in ANALYSES:
        return analyses.uses(row)
    if row["domain"] in PUZZLES:
        return puzzles.uses(row)
    return atari.uses(row) if row["domain"] == "atari" else babyai.uses(row)


if __name__ == "__main__":
    sys.exit(main())
