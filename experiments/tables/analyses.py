"""The tables of the analyses: every way to plan of every case."""

from collections.abc import Sequence

from experiments import ablation, properties, stochastic, suboptimal
from experiments.common.cases import Analysis, select_rows
from experiments.tables.cells import format_beside, make_table
from leapjax.running.results import Row

ANALYSES = {
    program.ANALYSIS.name: program.ANALYSIS
    for program in (properties, stochastic, suboptimal, ablation)
}
PRESETS = ("paper", "leapjax")
# Each method without a cost of revisits, at two temperatures where noise matters. Below each sum
# stands one part of it.
NOISY = (
    "leap, with noise", "sum, with more noise", "dt, with noise", "dt, with more noise",
    "iql, with noise", "iql, with more noise",
)  # fmt: skip
WITHOUT_REVISITS = (
    *("next action", "whole plan", "leap", "sum", "one half alone", "pick-up alone", "dt", "iql"),
    *NOISY,
)
CONSTRAINED = (
    "adaptation",
    "generalization",
    "composition",
    "constraints-room",
    "constraints-maze",
)
EXPLORING = tuple(
    f"{way}, exploring{rest}"
    for way in ("whole plan", "leap", "sum", "dt", "iql")
    for rest in ("", ", replanned after each action", ", beam search")
)
ERRANDS = ("constraints-errand", "constraints-detour")


def is_used(row: Row) -> bool:
    """Tells whether today's code makes such a row; tables do not show every way."""
    of = ANALYSES[row["experiment"]]
    return any(
        select_rows(of, [row], case, way, row["preset"]) for case in of.cases for way in case.ways
    )


def compare_ways(
    of: Analysis, rows: Sequence[Row], ways: Sequence[str] = (), cases: Sequence[str] = ()
) -> str:
    """Tabulates the success of some ways, with both presets, beside the paper's number.

    Args:
        of: analysis.
        rows: rows of the analysis.
        ways: names of ways; all if empty.
        cases: prefixes of the names of cases; all if empty.
    """
    lines = []
    for case in of.cases:
        if cases and not case.name.startswith(tuple(cases)):
            continue
        for way in case.ways:
            if ways and way.name not in ways:
                continue
            found = [select_rows(of, rows, case, way, preset) for preset in PRESETS]
            if any(found):
                planner = way.name
                if not way.name.startswith(way.method):
                    planner = f"{way.method}: {way.name}"
                paper = "-" if way.paper is None else f"{way.paper:.1f}%"
                cells = [
                    _format_cell(mine, way.paper if preset == "paper" else None)
                    for preset, mine in zip(PRESETS, found, strict=True)
                ]
                lines.append([case.name, planner, paper, *cells])
    presets = (f"preset `{each}`" for each in PRESETS)
    return make_table(" | ".join(["case", "planner", "published", *presets]), lines)


def _format_cell(rows: Sequence[Row], published: float | None) -> str:
    """Formats the success of rows, one for each seed, with violations if there are any.

    Marks a success that differs from a published number, see `format_beside`.
    """
    cell = format_beside(rows, published)
    violations = sum(row["violations"] or 0 for row in rows)
    if violations:
        cell += f", {violations / sum(row['episodes'] for row in rows):.2g} violations an episode"
    return cell


def compare_energies(found: Sequence[Row]) -> str:
    """Tabulates energies of good and bad plans after training, and of the planner's plans."""
    shares = [name for each in found[:1] for name in each["training"][-1] if name != "step"]
    lines = []
    for each in found:
        last, planned = each["training"][-1], each["planning"]["mean"]
        energies = [f"{last[share]:.2f}" for share in shares]
        passes = [f"{planned[0]:.2f}", f"{planned[-1]:.2f}"]
        lines.append([each["level"], f"`{each['preset']}`", *energies, *passes])
    titles = [f"{share.removeprefix('random_')}% random" for share in shares]
    return make_table(" | ".join(["level", "preset", *titles, "plans, N = 1", "last"]), lines)
