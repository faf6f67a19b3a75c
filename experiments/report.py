"""Tables in the documents, made from the committed rows: `python -m experiments.report`."""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.common import program, results
from experiments.common.results import Row
from leapjax import scores
from leapjax.babyai.levels import LEVELS
from leapjax.checkpoints import read_json
from leapjax.data.seeds import UNSEEN
from leapjax.files import read_text, write_text

PAPER_DEMOS = 500
FRESH = (UNSEEN, 500)  # test levels: the first one's seed, and how many
EARLIER = (0, 200)  # those that results were played on before


@dataclasses.dataclass(frozen=True)
class Setting:
    """A column of the tables: which rows belong in it."""

    title: str
    preset: str
    method: str = "leap"
    masking: str | None = None  # None: a method that has no such option
    executed: int | None = None  # actions executed before replanning; None: the whole plan
    demos: int = PAPER_DEMOS

    def has(self, row: Row) -> bool:
        """Whether a row is a result of this setting, on its test levels."""
        return (
            not row["validation"]
            and _levels(row) in (FRESH, EARLIER)
            and (row["method"], row["preset"]) == (self.method, self.preset)
            and row["configuration"]["method_settings"].get("masking") == self.masking
            and row["executed"] == (self.executed or row["horizon"])
        )


def _levels(row: Row) -> tuple[int, int]:
    return row["first_episode_seed"], row["episodes"]


OURS = Setting("preset `leapjax`", "leapjax", masking="random")
SETTINGS = (
    Setting("random", "leapjax", "random", demos=0),
    Setting("preset `paper`", "paper", masking="one"),
    Setting("`paper`, `--masking each`", "paper", masking="each"),
    OURS,
    # Chosen on validation levels: docs/tried.md.
    Setting("`leapjax`, `--executed 3`", "leapjax", masking="random", executed=3),
)
TITLES = " | ".join(setting.title for setting in SETTINGS)
DOCUMENTS = ("README.md", "docs/performance.md", "docs/experiments.md")


def main() -> int:
    """Rewrites every table here."""
    return program.guarded("experiments.report", (), rewrite)


def rewrite() -> None:
    """Rewrites every table here."""
    for path, text in documents(Path()).items():
        write_text(path, text)


def documents(root: Path) -> dict[Path, str]:
    """What each document with tables should say, given the rows."""
    rows: dict[str, list[Row]] = {"babyai": results.read(root / "results" / "babyai.jsonl")}
    for name in ("planning", "training"):
        rows[name] = read_json(root / "results" / f"{name}.json")
    sections: dict[str, tuple[Callable[[Sequence[Row]], str], str]] = {
        "results": (success, "babyai"),
        "speed": (speed, "planning"),
        "planning": (planning, "planning"),
        "training": (training, "training"),
        "steps": (steps, "babyai"),
    }
    written = {}
    for path in (root / name for name in DOCUMENTS):
        text = read_text(path)
        for name, (make, source) in sections.items():
            if f"<!-- {name}: begin -->" in text:
                text = replace_section(text, name, make(rows[source]))
        written[path] = text
    return written


def replace_section(text: str, name: str, section: str) -> str:
    """The text with what is between the two markers of that name replaced."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n\n{section}\n\n{end}{after}"


def success(rows: Sequence[Row]) -> str:
    """Success rates per level: the paper's, and those of every setting.

    A cell is the mean over seeds, its 95% interval, and the number of seeds.
    """
    lines = [
        [level.name, f"{level.paper_success:.1f}%", *cells]
        for level, cells in zip(LEVELS.values(), _by_setting(rows, _rate), strict=True)
    ]
    return _table(f"level | paper | {TITLES}", lines)


def steps(rows: Sequence[Row]) -> str:
    """Steps per episode, failed episodes included, of every setting."""
    found = zip(LEVELS, _by_setting(rows, _mean_length), strict=True)
    return _table(f"level | {TITLES}", [[level, *cells] for level, cells in found])


def _by_setting(rows: Sequence[Row], cell: Callable[[Sequence[Row]], str]) -> list[list[str]]:
    """For each level what `cell` makes of its rows, setting by setting."""
    columns = [(setting, _by_level_and_demos(rows, setting)) for setting in SETTINGS]
    return [
        [cell(column.get((level, setting.demos), [])) for setting, column in columns]
        for level in LEVELS
    ]


def _by_level_and_demos(rows: Sequence[Row], setting: Setting) -> dict[tuple[str, int], list[Row]]:
    """The rows of a setting by level and number of demonstrations.

    Those on fresh test levels, where there are some. Of two of one seed the one of the training,
    not the one of its checkpoint played again.
    """
    found: dict[tuple[str, int], dict[tuple[int, int], dict[int, Row]]] = {}
    for row in sorted(filter(setting.has, rows), key=lambda row: row["train_steps"] > 0):
        by_levels = found.setdefault((row["level"], row["demos"]), {})
        by_levels.setdefault(_levels(row), {})[row["seed"]] = row
    chosen = {key: by_levels.get(FRESH) or by_levels[EARLIER] for key, by_levels in found.items()}
    return {key: list(by_seed.values()) for key, by_seed in chosen.items()}


def speed(rows: Sequence[Row]) -> str:
    """Plans per second at batch 256 and alone."""
    lines = []
    for row in rows:
        if row["batch"] != 256:
            continue
        same = ("preset", "horizon", "iterations")
        alone = next(r for r in rows if r["batch"] == 1 and all(r[key] == row[key] for key in same))
        lines.append(
            [
                f"T = {row['horizon']}, N = {row['iterations']}",
                f"`{row['preset']}`",
                f"{row['plans_per_second']:,.0f}",
                f"{row['fraction_of_peak']:.0%}",
                f"{1e3 * alone['seconds']:.1f} ms",
            ]
        )
    header = "plan | preset | plans per second | of the matrix-multiply peak | one alone"
    return _table(header, lines)


def planning(rows: Sequence[Row]) -> str:
    """Every measurement of planning."""
    lines = [
        [
            f"`{row['preset']}`",
            f"{row['horizon']}, {row['iterations']}",
            str(row["batch"]),
            f"{row['plans_per_second']:,.0f}",
            f"{row['gflops']:.0f}",
            f"{row['peak_gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
        ]
        for row in rows
        if row["batch"] in (1, 16, 256, 1024)
    ]
    return _table("preset | T, N | batch | plans/s | GFLOP/s | peak | fraction", lines)


def training(rows: Sequence[Row]) -> str:
    """Every measurement of training."""
    lines = [
        [
            row["level"],
            f"`{row['preset']}`",
            f"{1e3 / row['steps_per_second']:.0f}",
            f"{row['encoder_share']:.0%}",
            f"{row['flops_per_step'] / 1e9:.1f}",
            f"{row['gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
            f"{row['training_seconds']:.0f} s for {row['steps']:,} steps",
        ]
        for row in rows
    ]
    header = "level | preset | ms/step | encoder | GFLOP/step | GFLOP/s | of the peak | a run"
    return _table(header, lines)


def _rate(rows: Sequence[Row]) -> str:
    """Mean success of some rows, one for each seed, with its interval and how many there are."""
    if not rows:
        return "-"
    successes = [row["successes"] for row in rows]
    episodes = [row["episodes"] for row in rows]
    low, high = scores.interval_over_seeds(successes, episodes)
    rate = f"{100 * sum(successes) / sum(episodes):.1f}% [{100 * low:.1f}, {100 * high:.1f}]"
    earlier = " \\*" if _levels(rows[0]) == EARLIER else ""
    return f"{rate}, {len(rows)} seed{'s' if len(rows) > 1 else ''}{earlier}"


def _mean_length(rows: Sequence[Row]) -> str:
    """Mean length of the episodes of some rows."""
    episodes = sum(row["episodes"] for row in rows)
    total = sum(row["mean_length"] * row["episodes"] for row in rows)
    return f"{total / episodes:.1f}" if rows else "-"


def _table(header: str, lines: Sequence[Sequence[str]]) -> str:
    columns = header.count("|") + 1
    rows = [f"| {header} |", "| " + " | ".join(["---"] * columns) + " |"]
    return "\n".join([*rows, *(f"| {' | '.join(cells)} |" for cells in lines)])


if __name__ == "__main__":
    sys.exit(main())
