"""Tables in the documents, made from the committed rows: `python -m experiments.report`."""

import dataclasses
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import ablation, properties, stochastic, suboptimal
from experiments.common import analysis, plots, program, results
from experiments.common.analysis import Analysis
from experiments.common.config import configuration_hash, with_options
from experiments.common.config import preset as config_of_preset
from experiments.common.results import Row
from experiments.common.searches import BEST_OF_MANY, SEARCHES
from leapjax import scores
from leapjax.atari.games import GAMES
from leapjax.babyai.levels import LEVELS, paper_success
from leapjax.checkpoints import read_json
from leapjax.files import read_text, write_text

EARLIER = {"test_seed": 0, "episodes": 200}  # test levels that were played during development


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a column of the tables holds: a method with a preset, and what differs from that."""

    title: str
    preset: str
    method: str = "leap"
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def has(self, row: Row, **options: Any) -> bool:
        """Whether a row is of this setting as it is today, trained or played again."""
        if (row["method"], row["preset"]) != (self.method, self.preset):
            return False
        changed = tuple(sorted({**self.options, **options}.items()))
        of = row["domain"], row["level"], self.method, self.preset
        return row["hash"] in _names(*of, changed, row["seed"])


@functools.cache  # many rows are asked whether they are of the same settings
def _names(
    domain: str,
    level: str,
    method: str,
    preset: str,
    options: tuple[tuple[str, Any], ...],
    seed: int,
) -> tuple[str, str]:
    """What rows of a configuration are called: of its training, and of its checkpoint played."""
    config = with_options(config_of_preset(domain, level, method, preset), dict(options))
    again = dataclasses.replace(config, checkpoint=Path())
    return configuration_hash(config, seed), configuration_hash(again, seed)


OURS = Setting("preset `leapjax`", "leapjax")
PAPER = Setting("preset `paper`", "paper")
SETTINGS = (
    Setting("random", "leapjax", "random"),
    PAPER,
    OURS,
    # Chosen on validation levels: docs/tried.md.
    Setting("`leapjax`, `--executed 3`", "leapjax", options={"executed": 3}),
)
TITLES = " | ".join(setting.title for setting in SETTINGS)
WITHOUT_DISTANCES = Setting("`leapjax`, `--fields 0`", "leapjax", options={"fields": 0})
# The methods of the paper's table, beside the floor, with both presets.
COMPARED = ("random", "bc", "bcq", "iql", "dt", "plate", "mopo", "leap")
BASELINES = tuple(method for method in COMPARED if method not in ("random", "leap"))
BY_METHOD = {
    preset: {method: Setting(method, preset, method) for method in COMPARED}
    for preset in ("paper", "leapjax")
}
ATARI = {
    "LEAP": Setting("LEAP", "leapjax"),
    "LEAP without return": Setting("LEAP", "leapjax", options={"returns": False}),
    "BC": Setting("BC", "leapjax", "bc"),
    "DT": Setting("DT", "leapjax", "dt"),
    "CQL": Setting("CQL", "leapjax", "cql"),
    "QR-DQN": Setting("QR-DQN", "leapjax", "qr_dqn"),
    "REM": Setting("REM", "leapjax", "rem"),
    "random": Setting("random", "leapjax", "random"),
}
PUZZLES = ("stars", "sudoku")  # experiments, named as their domains
ITERATED = (PAPER, WITHOUT_DISTANCES, OURS)
ITERATIONS = (1, 2, 5, 10, 15, 30, 50)  # T and the paper's N of every level, and fewer
# Where plans are executed whole: what is minimised, and methods of one action.
LEARNED = ", learned"
ARMS_LEVEL, ARMS = "Star3x5", (2, 3, 5, 7, 9)  # what was learned, and what it is played on
MINIMISED = {
    LEARNED: Setting("learned", "leapjax"),
    ", rules": Setting("rules", "leapjax", "rules"),
    ", learned and rules": Setting("both", "leapjax", options={"rules": 1.0}),
}
ONE_ACTION = tuple(Setting(method, "leapjax", method) for method in ("bc", "dt"))
TIMED = ("GoToLocalS8N7", "GoToObjMazeS4R2Close")  # levels played with nothing else running
MEASURED = (  # files of rows beside those of experiments
    "planning", "training", "quality", "landscape", "atari-data", "atari-energy", "atari-cost",
)  # fmt: skip
DOCUMENTS = ("README.md", "docs/performance.md", "docs/experiments.md", "docs/results.md")
ANALYSES = {
    program.ANALYSIS.name: program.ANALYSIS
    for program in (properties, stochastic, suboptimal, ablation)
}
EXPERIMENTS = ("babyai", "atari", *PUZZLES, *ANALYSES)  # that have rows
ITERATIONS_FIGURE, METHODS_FIGURE = Path("docs/iterations.png"), Path("docs/methods.png")
SEARCHES_FIGURE, ENERGY_FIGURE = Path("docs/searches.png"), Path("docs/atari-energy.png")
LANDSCAPE_FIGURE, AGGREGATE_FIGURE = Path("docs/landscape.png"), Path("docs/aggregate.png")


def main() -> int:
    """Rewrites every table here."""
    return program.guarded("experiments.report", (), rewrite)


def rewrite() -> None:
    """Rewrites every table here."""
    for path, text in documents(Path()).items():
        write_text(path, text)
    rows = rows_of(Path(), "babyai")
    plots.iterations_by_level(success_by_iterations(rows), ITERATIONS_FIGURE)
    plots.methods_by_level(success_by_method(rows), COMPARED, METHODS_FIGURE)
    plots.iterations_by_level(success_by_passes(rows_of(Path(), *PUZZLES)), SEARCHES_FIGURE)
    plots.intervals(aggregates(rows), AGGREGATE_FIGURE)
    plots.landscape(read_json(Path("results/landscape.json")), LANDSCAPE_FIGURE)
    plots.energy_against_reward(read_json(Path("results/atari-energy.json")), ENERGY_FIGURE)


def rows_of(root: Path, *names: str) -> list[Row]:
    """The rows of some experiments."""
    return [row for name in names for row in results.read(root / "results" / f"{name}.jsonl")]


def documents(root: Path) -> dict[Path, str]:
    """What each document with tables should say, given the rows."""
    rows: dict[str, Any] = {
        "babyai": rows_of(root, "babyai"),
        "puzzles": rows_of(root, *PUZZLES),
    }
    for name in ("atari", *ANALYSES):
        rows[name] = rows_of(root, name)
    for name in MEASURED:
        rows[name] = read_json(root / "results" / f"{name}.json")
    sections: dict[str, tuple[Callable[[Any], str], str]] = {
        "results": (success, "babyai"),
        "speed": (speed, "planning"),
        "planning": (planning, "planning"),
        "training": (training, "training"),
        "parts": (parts, "training"),
        "steps": (steps, "babyai"),
        "iterations": (iterations, "babyai"),
        "methods": (methods, "babyai"),
        "acting": (acting, "babyai"),
        "price": (price, "babyai"),
        "searches": (searches, "puzzles"),
        "arms": (arms, "puzzles"),
        "atari": (functools.partial(atari, data=rows["atari-data"]), "atari"),
        "atari-data": (atari_data, "atari-data"),
        "atari-energy": (atari_energy, "atari-energy"),
        "atari-decisions": (decisions, "atari-cost"),
        "atari-training": (training, "atari-cost"),
        "quality": (quality, "quality"),
        "landscape": (landscape, "landscape"),
        **{name: (functools.partial(analysed, each), name) for name, each in ANALYSES.items()},
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
    """Success rates per level: the paper's, and those of every setting; their middle.

    A cell is the mean over seeds, its 95% interval, and the number of seeds.
    """
    papers = [paper_success(level)["leap"] for level in LEVELS]
    lines = [
        [level, f"{paper:.1f}%", *cells]
        for level, paper, cells in zip(LEVELS, papers, _by_setting(rows, _rate), strict=True)
    ]
    paper = scores.interquartile_mean(np.array(papers))
    found = [_middle(rows, setting) for setting in SETTINGS]
    cells = [
        "-" if each is None else f"{each[0]:.1f}% [{each[1]:.1f}, {each[2]:.1f}]" for each in found
    ]
    lines.append(["interquartile mean", f"{paper:.1f}%", *cells])
    return _table(f"level | paper | {TITLES}", lines)


def aggregates(rows: Sequence[Row]) -> dict[str, tuple[float, float, float]]:
    """The interquartile means of the paper's LEAP, and of what has rows on every level."""
    paper = float(
        scores.interquartile_mean(np.array([paper_success(level)["leap"] for level in LEVELS]))
    )
    methods = [
        dataclasses.replace(setting, title=f"{method}, {preset}")
        for preset, by_method in BY_METHOD.items()
        for method, setting in by_method.items()
        if method not in ("random", "leap")
    ]
    found = {setting.title: _middle(rows, setting) for setting in (*SETTINGS, *methods)}
    known = {title: each for title, each in found.items() if each is not None}
    return {"LEAP, the paper's numbers": (paper, paper, paper), **known}


def steps(rows: Sequence[Row]) -> str:
    """Steps per episode, failed episodes included, of every setting."""
    found = zip(LEVELS, _by_setting(rows, _mean_length), strict=True)
    return _table(f"level | {TITLES}", [[level, *cells] for level, cells in found])


def _by_setting(rows: Sequence[Row], cell: Callable[[Sequence[Row]], str]) -> list[list[str]]:
    """For each level what `cell` makes of its rows, setting by setting."""
    by_level = {level: [row for row in rows if row["level"] == level] for level in LEVELS}
    return [
        [cell(_of_setting(by_level[level], setting)) for setting in SETTINGS] for level in LEVELS
    ]


def _of_setting(rows: Sequence[Row], setting: Setting, **options: Any) -> list[Row]:
    """The rows of a setting, one for each seed.

    Those on fresh test levels, where there are some. Of two of one seed the one of the training,
    not the one of its checkpoint played again.
    """
    ordered = sorted(rows, key=lambda row: row["train_steps"] > 0)
    for levels in ({}, EARLIER):
        found = [row for row in ordered if setting.has(row, **levels, **options)]
        if found:
            return list({row["seed"]: row for row in found}.values())
    return []


def is_used(row: Row) -> bool:
    """Whether a row is in a table; one that is in none is stale."""
    if row.get("experiment") in ANALYSES:
        of = ANALYSES[row["experiment"]]
        return any(
            analysis.rows_of_way(of, [row], case, way, row["preset"])
            for case in of.cases
            for way in case.ways
        )
    if row["domain"] == "atari":
        return any(setting.has(row) for setting in ATARI.values())
    if row["domain"] not in PUZZLES and row["level"] not in LEVELS:
        return False
    if row["domain"] in PUZZLES:
        searched = any(of for each in rows_by_search([row]).values() for _, _, of in each)
        return searched or any(of for _, _, of in rows_by_arms([row]))
    changes = ({}, EARLIER, *({"iterations": n} for n in ITERATIONS))
    settings = (*SETTINGS, *ITERATED, *(s for each in BY_METHOD.values() for s in each.values()))
    return any(setting.has(row, **change) for setting in settings for change in changes)


def success_by_iterations(rows: Sequence[Row]) -> dict[str, dict[str, dict[int, Row]]]:
    """Rows of training seed 0 by level, title of the setting, and N."""
    found: dict[str, dict[str, dict[int, Row]]] = {}
    for level in LEVELS:
        mine = [row for row in rows if row["level"] == level and row["seed"] == 0]
        for setting in ITERATED:
            counts = {n: _of_setting(mine, setting, iterations=n) for n in ITERATIONS}
            by_count = {n: played[0] for n, played in counts.items() if played}
            if len(by_count) > 1:  # one alone says nothing of iterating
                found.setdefault(level, {})[setting.title] = by_count
    return found


def iterations(rows: Sequence[Row]) -> str:
    """Success rates against the number of iterations, of training seed 0."""

    def rate(row: Row | None) -> str:
        return f"{100 * row['successes'] / row['episodes']:.1f}%" if row else ""

    lines = [
        [level, title, *(rate(by_count.get(n)) for n in ITERATIONS)]
        for level, by_title in success_by_iterations(rows).items()
        for title, by_count in by_title.items()
    ]
    return _table("level | preset | " + " | ".join(f"N = {n}" for n in ITERATIONS), lines)


def rows_by_method(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, list[Row]]]]:
    """Rows by level, preset and method, of levels where there are some of a baseline."""
    found = {}
    for level in LEVELS:
        mine = [row for row in rows if row["level"] == level]
        by_preset = {
            preset: {method: _of_setting(mine, setting) for method, setting in settings.items()}
            for preset, settings in BY_METHOD.items()
        }
        if any(by_method[name] for by_method in by_preset.values() for name in BASELINES):
            found[level] = by_preset
    return found


def success_by_method(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Success in percent by level, whose numbers they are, and method."""
    return {
        level: {
            "the paper": paper_success(level),
            **{
                f"preset {preset}": {name: _mean_rate(of) for name, of in by_method.items() if of}
                for preset, by_method in by_preset.items()
            },
        }
        for level, by_preset in rows_by_method(rows).items()
    }


def methods(rows: Sequence[Row]) -> str:
    """Success rates of every method: the paper's, and those of both presets; the best in bold."""
    lines = []
    for level, by_preset in rows_by_method(rows).items():
        theirs = paper_success(level)
        cells = {name: f"{rate:.1f}%" for name, rate in theirs.items()}
        lines.append([level, "the paper", *_compared(theirs, cells)])
        for preset, by_method in by_preset.items():
            ours = {name: _mean_rate(of) for name, of in by_method.items() if of}
            cells = {name: _rate(by_method[name]) for name in ours}
            lines.append([level, f"preset {preset}", *_compared(ours, cells)])
    return _table("level | | " + " | ".join(COMPARED), lines)


def _compared(rates: Mapping[str, float], cells: Mapping[str, str]) -> list[str]:
    """The cell of every method, those of the best rate in bold."""
    best = max(rates.values(), default=None)
    bold = {name: f"**{cell}**" for name, cell in cells.items() if rates[name] == best}
    return [{**cells, **bold}.get(name, "-") for name in COMPARED]


def acting(rows: Sequence[Row]) -> str:
    """Steps of an episode, and plans where they are fewer, with preset `leapjax`, seed 0."""

    def cell(row: Row) -> str:
        steps, plans = row["mean_length"], row["plans"] / row["episodes"]
        return f"{steps:.1f}" if round(steps - plans, 1) == 0 else f"{steps:.1f} ({plans:.1f})"

    return _by_acting_method(rows, cell)


def price(rows: Sequence[Row]) -> str:
    """Milliseconds of planning for each action, with preset `leapjax`, seed 0."""

    def cell(row: Row) -> str:
        planning = row["plans"] / row["plans_per_second"]
        return f"{1e3 * planning / (row['mean_length'] * row['episodes']):.2f}"

    return _by_acting_method([row for row in rows if row["level"] in TIMED], cell)


def _by_acting_method(rows: Sequence[Row], cell: Callable[[Row], str]) -> str:
    """A line for each level, a cell for each method: of preset `leapjax` and training seed 0."""
    methods = [name for name in COMPARED if name != "random"]
    lines = []
    for level, by_preset in rows_by_method(rows).items():
        first = {
            name: cell(row)
            for name, every in by_preset["leapjax"].items()
            for row in every
            if row["seed"] == 0
        }
        lines.append([level, *(first.get(name, "-") for name in methods)])
    return _table("level | " + " | ".join(methods), lines)


def rows_by_search(rows: Sequence[Row]) -> dict[str, list[tuple[str, str, list[Row]]]]:
    """By level and what is minimised: name, passes and rows of each way.

    Each has the same ways to search, whether there are rows or not.
    """
    found = {}
    for domain, level in {(row["domain"], row["level"]): None for row in rows}:
        mine = [row for row in rows if (row["domain"], row["level"]) == (domain, level)]
        horizon = config_of_preset(domain, level, "leap", "leapjax").planner.horizon
        for suffix, setting in MINIMISED.items():
            ways: list[tuple[str, str, list[Row]]] = []
            for search in (*SEARCHES, BEST_OF_MANY):
                options = {**setting.options, **search.of(horizon)}
                of = _of_setting(mine, dataclasses.replace(setting, options=options))
                ways.append((search.name, search.cost, of))
            for one in ONE_ACTION:
                of = _of_setting(mine, one) if suffix == LEARNED else []
                ways.append((f"`--method {one.method}`", "T", of))
            if any(of for _, _, of in ways):
                found[f"{level}{suffix}"] = ways
    return found


def searches(rows: Sequence[Row]) -> str:
    """Success of every way to search with the same trained energy, beside methods of one action."""
    found = rows_by_search(rows)
    lines = []
    for each in zip(*found.values(), strict=True):  # one search, on every level
        name, passes, _ = each[0]
        lines.append([name, passes, *(_rate(of) for _, _, of in each)])
    return _table(" | ".join(["planner", "passes", *found]), lines)


def rows_by_arms(rows: Sequence[Row]) -> list[tuple[str, int, list[Row]]]:
    """Of what has learned graphs of three arms: the search, arms that it was played on, rows."""
    trained = [row for row in rows if row["level"] == ARMS_LEVEL]
    horizon = config_of_preset("stars", ARMS_LEVEL, "leap", "leapjax").planner.horizon
    found = []
    for search in SEARCHES:
        for count in ARMS:
            level = f"Star{count}x{horizon}"
            play = {} if level == ARMS_LEVEL else {"play": level}
            setting = dataclasses.replace(
                MINIMISED[LEARNED], options={**search.of(horizon), **play}
            )
            found.append((f"{search.name}, {search.cost}", count, _of_setting(trained, setting)))
    return found


def arms(rows: Sequence[Row]) -> str:
    """Success on star graphs of other numbers of arms than were learned."""
    by_search: dict[str, list[list[Row]]] = {}
    for name, _, of in rows_by_arms(rows):
        by_search.setdefault(name, []).append(of)
    lines = [
        [name, *(_rate(of) for of in each)]
        for name, each in by_search.items()
        if sum(map(bool, each)) > 1
    ]
    return _table(" | ".join(["planner, passes", *(f"{n} arms" for n in ARMS)]), lines)


def atari(rows: Sequence[Row], data: Mapping[str, Any]) -> str:
    """Scores of every method and game, 0 as random actions' and 100 as a gamer's; and as they are.

    With the standard error, over seeds where there are several and over games where there is one;
    and the mean score of the games that were learned from.
    """
    columns = [*ATARI, "the data"]
    lines = []
    for name, game in GAMES.items():
        of = {
            title: [row for row in rows if row["level"] == name and setting.has(row)]
            for title, setting in ATARI.items()
        }
        theirs = {"LEAP without return": game.paper_without_return} | {
            title: game.paper[setting.method]
            for title, setting in ATARI.items()
            if setting.method in game.paper and not setting.options
        }
        scale = game.human - game.random
        cells = {title: _mean_score(found) for title, found in of.items() if found}
        normal = {
            title: f"{game.normalised(mean):.1f} ± {100 * error / scale:.1f}"
            for title, (mean, error) in cells.items()
        }
        raw = {title: f"{mean:.1f} ± {error:.1f}" for title, (mean, error) in cells.items()}
        papers = {title: f"{score:.1f}" for title, score in theirs.items()}
        if cells and name in data:
            reached = float(np.mean([played["score"] for played in data[name]]))
            normal |= {"the data": f"{game.normalised(reached):.1f}"}
            raw |= {"the data": f"{reached:.1f}"}
        for what, by_title in {"paper": papers, "ours": normal, "our score": raw}.items():
            if by_title:
                lines.append([name, what, *(by_title.get(title, "-") for title in columns)])
    return _table("game | | " + " | ".join(columns), lines)


def _mean_score(rows: Sequence[Row]) -> tuple[float, float]:
    """The mean score of rows, one for each seed, and its standard error."""
    means = np.array([row["mean_return"] for row in rows])
    error = scores.standard_error(means) if len(rows) > 1 else rows[0]["return_error"]
    return float(means.mean()), error or 0.0


def atari_data(found: Mapping[str, Any]) -> str:
    """What the demonstrators reached, whose games are learned from."""
    lines = []
    for name in GAMES:
        games = found.get(name, [])
        if not games:
            continue
        reached = np.array([game["score"] for game in games])
        by_noise = {
            noise: np.mean([game["score"] for game in games if game["noise"] == noise])
            for noise in sorted({game["noise"] for game in games})
        }
        lines.append(
            [
                name,
                str(len(games)),
                str(sum(game["transitions"] for game in games)),
                f"{reached.mean():.1f}",
                f"{reached.min():g} .. {reached.max():g}",
                ", ".join(f"{mean:.1f} ({noise:.0%})" for noise, mean in by_noise.items()),
            ]
        )
    return _table("game | games | transitions | mean score | range | by random actions", lines)


def atari_energy(found: Mapping[str, Any]) -> str:
    """How energies of trajectories and their rewards are correlated."""
    lines = [
        [name, str(len(of["energies"])), f"{of['correlation']:.2f}", f"{of['p_value']:.1g}"]
        for name in GAMES
        if (of := found.get(name))
    ]
    return _table("game | trajectories | rank correlation of energy and reward | p", lines)


def success_by_passes(rows: Sequence[Row]) -> dict[str, dict[str, dict[int, Row]]]:
    """By level, name of the search, and number of passes: rows of what was learned, added up."""
    added: dict[str, dict[str, dict[int, Row]]] = {}
    planned = [row for row in rows if row["method"] == "leap"]
    for level, ways in rows_by_search(planned).items():
        for name, _, of in ways if level.endswith(LEARNED) else []:
            if of:
                sums = {key: sum(row[key] for row in of) for key in ("successes", "episodes")}
                added.setdefault(level, {}).setdefault(name, {})[of[0]["iterations"]] = sums
    return added


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
    return _table(" | ".join(["level", "preset", *titles, "plans, N = 1", "last"]), lines)


def analysed(of: Analysis, rows: Sequence[Row]) -> str:
    """Every way to plan of every case, beside the paper's number; the best of a case in bold."""
    watched = any(row["violations"] is not None for row in rows)
    lines = []
    for case in of.cases:
        found = [
            (way, preset, mine)
            for way in case.ways
            for preset in ("paper", "leapjax")
            if (mine := analysis.rows_of_way(of, rows, case, way, preset))
        ]
        best = max((_mean_rate(mine) for _, _, mine in found), default=None)
        for way, preset, mine in found:
            rate = f"**{_rate(mine)}**" if _mean_rate(mine) == best else _rate(mine)
            first = [row["first_pass_successes"] for row in mine]
            episodes = sum(row["episodes"] for row in mine)
            cells = [
                case.name,
                way.name if way.name.startswith(way.method) else f"{way.method}: {way.name}",
                f"`{preset}`",
                "-" if way.paper is None else f"{way.paper:.1f}%",
                "-" if None in first else f"{100 * sum(first) / episodes:.1f}%",
                rate,
                _mean_length(mine),
            ]
            if of.timed:
                cells.append(f"{_milliseconds(mine):.2f}")
            if watched:
                counts = [row["violations"] for row in mine]
                cells.append("-" if None in counts else f"{sum(counts) / episodes:.2f}")
            lines.append(cells)
    header = "case | planner | preset | paper | N = 1 | success | steps"
    header += " | ms per plan" if of.timed else ""
    return _table(f"{header} | violations" if watched else header, lines)


def _milliseconds(rows: Sequence[Row]) -> float:
    """What a plan costs, hundreds at once."""
    plans = sum(row["plans"] for row in rows)
    return 1e3 * sum(row["plans"] / row["plans_per_second"] for row in rows) / plans


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


def quality(rows: Sequence[Row]) -> str:
    """What each way to search gives and costs, for each planner: success, steps, ms per plan."""

    def cell(row: Row) -> str:
        rate, milliseconds = row["successes"] / row["episodes"], 1e3 / row["plans_per_second"]
        return f"{rate:.1%}, {row['mean_length']:.1f}, {milliseconds:.2f}"

    planners = list(dict.fromkeys((row["level"], row["preset"]) for row in rows))
    found = {(row["level"], row["preset"], row["variant"]): cell(row) for row in rows}
    titles = [f"{level}, `{preset}`" for level, preset in planners]
    lines = [
        [variant, *(found.get((*planner, variant), "-") for planner in planners)]
        for variant in dict.fromkeys(row["variant"] for row in rows)
    ]
    return _table(" | ".join(["search", *titles]), lines)


def decisions(rows: Sequence[Row]) -> str:
    """What decisions are made of in games that are played together, in milliseconds."""
    lines = []
    for row in rows:
        if "playing_seconds" not in row:
            continue
        parts = ("planning", "encoding", "anew", "playing")
        spent = [row[f"{part}_seconds"] for part in parts]
        rate = row["batch"] / (row["planning_seconds"] + row["playing_seconds"])
        cells = [f"{1e3 * seconds:.1f}" for seconds in spent]
        lines.append([f"`{row['preset']}`", str(row["batch"]), *cells, f"{rate:,.0f}"])
    header = "preset | games | planner | of it encoder | past encoded anew | emulator | decisions/s"
    return _table(header, lines)


def training(rows: Sequence[Row]) -> str:
    """Every measurement of training."""
    lines = [
        [
            row["level"],
            f"`{row['preset']}`" + (f", `--run {row['run']}`" if row.get("run", 1) > 1 else ""),
            f"{1e3 / row['steps_per_second']:.0f}",
            f"{row['flops_per_step'] / 1e9:.1f}",
            f"{row['gflops']:.0f}",
            f"{row['fraction_of_peak']:.0%}",
            f"{row['training_seconds']:,.0f} s for {row['steps']:,} steps",
        ]
        for row in rows
        if "steps_per_second" in row
    ]
    header = "level | preset | ms/step | GFLOP/step | GFLOP/s | of the peak | a run"
    return _table(header, lines)


def parts(rows: Sequence[Row]) -> str:
    """Where the time of a step goes, of every measurement of training."""
    lines = []
    for row in rows:
        step = 1e3 / row["steps_per_second"]
        found = [f"{part['ms']:.1f}" for part in row["parts"]]
        rates = [
            f" ({part['gflop'] / part['ms'] * 1e3:.0f})" if part["gflop"] else ""
            for part in row["parts"]
        ]
        cells = [ms + rate for ms, rate in zip(found, rates, strict=True)]
        lines.append([row["level"], f"`{row['preset']}`", f"{step:.1f}", *cells])
    names = [part["part"] for part in rows[0]["parts"]] if rows else []
    return _table(" | ".join(["level", "preset", "step", *names]), lines)


def _rate(rows: Sequence[Row]) -> str:
    """Mean success of some rows, one for each seed, with its interval and how many there are."""
    if not rows:
        return "-"
    successes = [row["successes"] for row in rows]
    episodes = [row["episodes"] for row in rows]
    low, high = scores.interval_over_seeds(successes, episodes)
    rate = f"{_mean_rate(rows):.1f}% [{100 * low:.1f}, {100 * high:.1f}]"
    earlier = " \\*" if rows[0]["first_episode_seed"] == EARLIER["test_seed"] else ""
    if rows[0]["method"] == "rules":  # nothing was trained
        return rate
    return f"{rate}, {len(rows)} seed{'s' if len(rows) > 1 else ''}{earlier}"


def _middle(rows: Sequence[Row], setting: Setting) -> tuple[float, float, float] | None:
    """The interquartile mean of a setting over all levels, and its interval, in percent."""
    levels = [
        _of_setting([row for row in rows if row["level"] == level], setting) for level in LEVELS
    ]
    if not all(levels):
        return None
    counts = [([r["successes"] for r in of], [r["episodes"] for r in of]) for of in levels]
    middle, (low, high) = scores.aggregate(counts)
    return 100 * middle, 100 * low, 100 * high


def _mean_rate(rows: Sequence[Row]) -> float:
    """Mean success of some rows, in percent."""
    return 100 * sum(row["successes"] for row in rows) / sum(row["episodes"] for row in rows)


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
