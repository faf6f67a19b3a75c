"""Tables in the documents, made from the committed rows: `python -m experiments.report`.

`experiments/tables/` holds the functions that make tables from rows.
"""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.common import figures
from experiments.tables import analyses, atari, babyai, measured, noise, puzzles, speed
from experiments.tables.analyses import ANALYSES
from experiments.tables.measured import MEASURED
from leapjax.errors import UserError
from leapjax.files import read_text, write_text
from leapjax.running import results, shell, startup
from leapjax.running.results import Row

DOCUMENTS = (
    "README.md",
    "docs/levels.md",
    "docs/performance.md",
    "docs/reproduction.md",
    "docs/search.md",
)
PUZZLES = ("stars", "sudoku", "satisfiability")  # experiments, named as their domains
EXPERIMENTS = ("babyai", "noise", "atari", *PUZZLES, *ANALYSES)  # that have rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrites the tables and figures in the current folder; returns the exit code."""
    given = shell.read_arguments(arguments)
    about = "Rewrites the tables in the documents, and the figures, from results/ in this folder."
    command = startup.format_command("experiments.report")
    argparse.ArgumentParser(command, description=about).parse_args(given)
    return shell.run_program("experiments.report", given, rewrite_tables)


def rewrite_tables() -> None:
    """Rewrites every table, and draws every figure of rows, in the current folder."""
    for path, text in make_documents(Path()).items():
        write_text(path, text)
    rows, folder = read_rows(Path(), "babyai"), Path("docs")
    by_passes = puzzles.group_by_passes(read_rows(Path(), *PUZZLES))
    figures.draw_iterations(babyai.group_by_iterations(rows), folder / "iterations.png")
    figures.draw_iterations(by_passes, folder / "searches.png")
    figures.draw_methods(
        babyai.compute_success_by_method(rows), babyai.COMPARED, folder / "methods.png"
    )
    figures.draw_intervals(babyai.compute_aggregates(rows), folder / "aggregate.png")
    figures.draw_landscape(_read_measured(Path(), "landscape"), folder / "landscape.png")
    figures.draw_energies(_read_measured(Path(), "atari-energy"), folder / "atari-energy.png")


def read_rows(root: Path, *names: str) -> list[Row]:
    """Reads the rows of some experiments, each with its recorded episodes, if there are any.

    Raises:
        UserError: a row is invalid, or belongs to another experiment.
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


def _read_measured(root: Path, name: str) -> Any:
    return measured.read_measured(root / "results" / f"{name}.json")


def read_sources(root: Path) -> dict[str, Any]:
    """Reads the sources of the tables: rows by experiment, and measurements by file."""
    rows: dict[str, Any] = {name: read_rows(root, name) for name in EXPERIMENTS}
    rows |= {name: _read_measured(root, name) for name in MEASURED}
    return rows | {"puzzles": [row for name in PUZZLES for row in rows[name]]}


def make_documents(root: Path) -> dict[Path, str]:
    """Returns the text of each document, with its tables made from the rows."""
    rows = read_sources(root)
    sections = list_sections(rows)
    written = {}
    for path in (root / name for name in DOCUMENTS):
        text = read_text(path)
        for name, (make, source) in sections.items():
            if f"<!-- {name}: begin -->" in text:
                text = replace_section(text, name, make(rows[source]))
        written[path] = text
    return written


def list_sections(rows: Mapping[str, Any]) -> dict[str, tuple[Callable[[Any], str], str]]:
    """Lists, by name of the section, the function that makes its table and that function's source.

    Args:
        rows: rows and measurements by source, for tables that need a second source.
    """
    properties = ANALYSES["properties"]
    return {
        "results": (
            functools.partial(babyai.compare_settings, settings=babyai.BESIDE_CLONING),
            "babyai",
        ),
        "iterations": (babyai.compare_iterations, "babyai"),
        "methods": (babyai.compare_methods, "babyai"),
        "noise": (noise.compare_temperatures, "noise"),
        "every-level": (
            functools.partial(babyai.list_levels, demonstrated=rows["demonstrator"]),
            "babyai",
        ),
        "price": (functools.partial(babyai.compare_prices, measured=rows["methods"]), "babyai"),
        "search-pays": (puzzles.compare_searches, "puzzles"),
        "arms": (puzzles.compare_arms, "puzzles"),
        "hard-boards": (puzzles.compare_boards, "puzzles"),
        "atari": (functools.partial(atari.compare_scores, data=rows["atari-data"]), "atari"),
        "atari-data": (atari.describe_data, "atari-data"),
        "atari-energy": (atari.compare_energies, "atari-energy"),
        "atari-decisions": (atari.compare_decisions, "atari-cost"),
        "atari-training": (speed.list_training, "atari-training"),
        "speed": (speed.compare_speed, "planning"),
        "planning": (speed.list_planning, "planning"),
        "training": (speed.list_training, "training"),
        "parts": (speed.list_parts, "training"),
        "quality": (speed.compare_quality, "quality"),
        "landscape": (analyses.compare_energies, "landscape"),
        "properties": (
            functools.partial(
                analyses.compare_ways,
                properties,
                ways=analyses.WITHOUT_REVISITS,
                cases=analyses.CONSTRAINED,
            ),
            "properties",
        ),
        "exploring": (
            functools.partial(analyses.compare_ways, properties, ways=analyses.EXPLORING),
            "properties",
        ),
        "two-constraints": (
            functools.partial(analyses.compare_ways, properties, cases=analyses.ERRANDS),
            "properties",
        ),
        **{
            name: (functools.partial(analyses.compare_ways, each), name)
            for name, each in ANALYSES.items()
            if name != "properties"
        },
    }


def replace_section(text: str, name: str, section: str) -> str:
    """Replaces the text between the two markers of a section."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n\n{section}\n\n{end}{after}"


def is_used(row: Row) -> bool:
    """Tells whether today's code makes such a row; any other row is stale."""
    if row.get("experiment") in ANALYSES:
        return analyses.is_used(row)
    if row.get("experiment") == "noise":
        return noise.is_used(row)
    if row["domain"] in PUZZLES:
        return puzzles.is_used(row)
    return atari.is_used(row) if row["domain"] == "atari" else babyai.is_used(row)


if __name__ == "__main__":
    sys.exit(main())
