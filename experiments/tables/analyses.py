"""The tables of the analyses: every way to plan of every case."""

from collections.abc import Sequence

from experiments import ablation, properties, stochastic, suboptimal
from experiments.common.cases import Analysis, Case, rows_of_way
from experiments.tables.cells import mean_length, mean_rate, milliseconds, minutes, rate, table
from leapjax.running.results import Row

ANALYSES = {
    program.ANALYSIS.name: program.ANALYSIS
    for program in (properties, stochastic, suboptimal, ablation)
}


def uses(row: Row) -> bool:
    """Whether a row is in a table."""
    of = ANALYSES[row["experiment"]]
    return any(
        rows_of_way(of, [row], case, way, row["preset"]) for case in of.cases for way in case.ways
    )


def analysed(of: Analysis, rows: Sequence[Row], kind: str = "") -> str:
    """Every way to plan of every case, beside the paper's number; the best of a case in bold.

    Of a kind of cases alone, if one is given: those whose names begin with it.
    """
    cases = [case for case in of.cases if case.name.startswith(kind)]
    names = {case.name for case in cases}
    watched = any(row["violations"] is not None for row in rows if row["case"] in names)
    lines = []
    for case in cases:
        found = [
            (way, preset, mine)
            for way in case.ways
            for preset in ("paper", "leapjax")
            if (mine := rows_of_way(of, rows, case, way, preset))
        ]
        best = max((mean_rate(mine) for _, _, mine in found), default=None)
        for way, preset, mine in found:
            success = f"**{rate(mine)}**" if mean_rate(mine) == best else rate(mine)
            first = [row["first_pass_successes"] for row in mine]
            episodes = sum(row["episodes"] for row in mine)
            cells = [
                case.name,
                way.name if way.name.startswith(way.method) else f"{way.method}: {way.name}",
                f"`{preset}`",
                "-" if way.paper is None else f"{way.paper:.1f}%",
                "-" if None in first else f"{100 * sum(first) / episodes:.1f}%",
                success,
                mean_length(mine),
            ]
            if of.timed:
                cells.append(f"{milliseconds(mine):.2f}")
            if watched:
                known = all(row["violations"] is not None for row in mine)
                cells.append(f"{_violations(mine):.2f}" if known else "-")
            lines.append([*cells, minutes(mine)])
    header = "case | planner | preset | paper | N = 1 | success | steps"
    header += " | ms per plan" if of.timed else ""
    header += " | violations" if watched else ""
    return table(f"{header} | minutes", lines)


def compared(of: Analysis, rows: Sequence[Row]) -> str:
    """Every case at a glance: LEAP's best way to plan beside the best choice of single actions.

    Of each preset, and apart from them with a penalty on coming back. The better of a pair is in
    bold. What is best was seen on the levels that it is of; what breaks a constraint more than
    once in twenty episodes is not.
    """

    def best(case: Case, preset: str, plans: bool, explores: bool) -> float | None:
        found = (
            rows_of_way(of, rows, case, way, preset)
            for way in case.ways
            if (way.method == "leap") == plans and way.explores == explores
        )
        kept = (mine for mine in found if mine and _violations(mine) <= 1 / 20)
        return max(map(mean_rate, kept), default=None)

    def papers(case: Case, plans: bool) -> float | None:
        known = (way.paper for way in case.ways if (way.method == "leap") == plans)
        return max((each for each in known if each is not None), default=None)

    lines = []
    for case in of.cases:
        cells = [case.name, *_pair(papers(case, True), papers(case, False))]
        for explores in (False, True):
            for preset in ("paper", "leapjax"):
                cells += _pair(*(best(case, preset, plans, explores) for plans in (True, False)))
        lines.append(cells)
    sources = (
        "in the paper", "preset `paper`", "preset `leapjax`",
        "`paper`, exploring", "`leapjax`, exploring",
    )  # fmt: skip
    return table(" | ".join(["case", *(f"LEAP, {each} | DT or IQL" for each in sources)]), lines)


def _violations(rows: Sequence[Row]) -> float:
    """Of constraints, in an episode."""
    return sum(row["violations"] or 0 for row in rows) / sum(row["episodes"] for row in rows)


def _pair(one: float | None, other: float | None) -> list[str]:
    """Two success rates in percent, the better in bold, both if they are alike."""
    known = [each for each in (one, other) if each is not None]

    def said(each: float | None) -> str:
        if each is None:
            return "-"
        return f"**{each:.1f}%**" if len(known) == 2 and each == max(known) else f"{each:.1f}%"

    return [said(one), said(other)]


def landscape(found: Sequence[Row]) -> str:
    """Energies of good and bad plans at the end of training, and of plans being refined."""
    shares = [name for each in found[:1] for name in each["training"][-1] if name != "step"]
    lines = []
    for each in found:
        last, planned = each["training"][-1], each["planning"]["mean"]
        energies = [f"{last[share]:.2f}" for share in shares]
        passes = [f"{planned[0]:.2f}", f"{planned[-1]:.2f}"]
        lines.append([each["level"], f"`{each['preset']}`", *energies, *passes])
    titles = [f"{share.removeprefix('random_')}% random" for share in shares]
    return table(" | ".join(["level", "preset", *titles, "plans, N = 1", "last"]), lines)
