"""The Atari tables: scores, data, energies against rewards, the time of a decision."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.atari import name_data, parse_game
from experiments.tables.cells import Columns, list_rows, make_table
from experiments.tables.settings import Setting, select
from leapjax import scores
from leapjax.domains.atari.domain import LONGEST
from leapjax.domains.atari.encoders import STACK
from leapjax.domains.atari.games import GAMES
from leapjax.presets.atari import PAPER_TRANSITIONS
from leapjax.running.results import Row

COLUMNS = {
    "LEAP": Setting("leapjax"),
    "LEAP without return": Setting("leapjax", changes={"method_settings": {"returns": False}}),
    "BC": Setting("leapjax", "bc"),
    "DT": Setting("leapjax", "dt"),
    "CQL": Setting("leapjax", "cql"),
    "QR-DQN": Setting("leapjax", "qr_dqn"),
    "REM": Setting("leapjax", "rem"),
    "random": Setting("leapjax", "random"),
}
# The runs at the paper's scale; `COLD` has the temperature of preset `leapjax`.
CONSECUTIVE = {"training": {"consecutive": 16}, "domain_settings": {"max_steps": LONGEST}}
LARGE = {
    "LEAP": Setting("paper", changes=CONSECUTIVE),
    "LEAP without return": Setting(
        "paper", changes={**CONSECUTIVE, "method_settings": {"returns": False}}
    ),
}
COLD = {title: setting.searching(temperature=0.1) for title, setting in LARGE.items()}
USED = (*COLUMNS.values(), *LARGE.values(), *COLD.values())


def is_used(row: Row) -> bool:
    """Tells whether a row is in a table."""
    return any(setting.has(row) for setting in USED)


def compare_scores(rows: Sequence[Row], data: Mapping[str, Any]) -> str:
    """Tabulates scores by method and game, with their standard errors.

    Scores are normalised (0: random actions, 100: a gamer) and raw. The last column is the mean
    score of the games that the methods learned from.
    """
    columns = [*COLUMNS, "the data"]
    lines = []
    for name, game in GAMES.items():
        theirs = {"LEAP without return": game.paper_without_return} | {
            title: game.paper[setting.method]
            for title, setting in COLUMNS.items()
            if setting.method in game.paper and not setting.changes
        }
        papers = {title: f"{score:.1f}" for title, score in theirs.items()}
        few = data.get(name, ())
        many = data.get(name_data(name, PAPER_TRANSITIONS), ())
        found = {"published": papers}
        found["preset `leapjax`"], found["preset `leapjax`: raw score"] = _format_scores(
            rows, name, COLUMNS, few
        )
        for setting, columns_of in (("", LARGE), (", temperature 0.1", COLD)):
            title = f"preset `paper`{setting}"
            found[title], found[f"{title}: raw score"] = _format_scores(
                rows, name, columns_of, many
            )
        for what, by_title in found.items():
            if by_title:
                lines.append([name, what, *(by_title.get(title, "-") for title in columns)])
    return make_table("game | | " + " | ".join(columns), lines)


def _format_scores(
    rows: Sequence[Row],
    level: str,
    settings: Mapping[str, Setting],
    games: Sequence[Mapping[str, Any]],
) -> tuple[dict[str, str], dict[str, str]]:
    """Formats normalised and raw scores by column, for the settings and for the data."""
    found = select(rows, [level], settings)
    cells = {title: _compute_mean_score(of) for (_, title), of in found.items() if of}
    game = GAMES[level]
    scale = game.human - game.random
    normal = {
        title: _format_with_error(game.normalised(mean), error and 100 * error / scale)
        for title, (mean, error) in cells.items()
    }
    raw = {title: _format_with_error(*each) for title, each in cells.items()}
    if cells and games:
        reached = float(np.mean([each["score"] for each in games]))
        normal |= {"the data": f"{game.normalised(reached):.1f}"}
        raw |= {"the data": f"{reached:.1f}"}
    return normal, raw


def _compute_mean_score(rows: Sequence[Row]) -> tuple[float, float | None]:
    """Computes the mean score of rows, one for each seed, and its standard error.

    The error is the larger of two: from the spread of the seeds' means, and from the spread of the
    games alone. A few seeds may agree by chance, so the second is a floor.

    The games give no error at temperature 0: without sticky actions, a greedy game depends only on
    its no-ops modulo the frame skip, so at most four games differ. A single game gives none either.
    The error is `None` if neither the games nor several seeds give one.
    """
    means = np.array([row["mean_return"] for row in rows])
    errors = np.array([row.get("return_error") for row in rows], float)  # NaN for a single game
    greedy = any(row["configuration"]["planner"].get("temperature") == 0 for row in rows)
    of_seeds = scores.standard_error(means)
    if greedy or np.isnan(errors).any():
        return float(means.mean()), of_seeds
    of_games = float(np.sqrt((errors**2).sum())) / len(rows)
    return float(means.mean()), max(of_seeds or 0.0, of_games)


def _format_with_error(mean: float, error: float | None) -> str:
    return f"{mean:.1f}" if error is None else f"{mean:.1f} ± {error:.1f}"


def describe_data(found: Mapping[str, Any]) -> str:
    """Tabulates the scores of the demonstrators."""
    lines = []
    for game in GAMES:
        for name in sorted(each for each in found if parse_game(each) == game):
            lines.append([name, *_describe_reached(found[name])])
    return make_table("game | games | transitions | mean score | range | by random actions", lines)


def _describe_reached(games: Sequence[Mapping[str, Any]]) -> list[str]:
    """Formats the numbers of games and transitions, and the scores."""
    reached = np.array([game["score"] for game in games])
    by_noise = {
        noise: np.mean([game["score"] for game in games if game["noise"] == noise])
        for noise in sorted({game["noise"] for game in games})
    }
    return [
        str(len(games)),
        str(sum(game["transitions"] for game in games)),
        f"{reached.mean():.1f}",
        f"{reached.min():g} .. {reached.max():g}",
        ", ".join(f"{mean:.1f} ({noise:.0%})" for noise, mean in by_noise.items()),
    ]


def compare_energies(found: Mapping[str, Any]) -> str:
    """Tabulates the rank correlation of energy and reward, by game."""
    lines = [
        [name, str(len(of["energies"])), f"{of['correlation']:.2f}", f"{of['p_value']:.1g}"]
        for name in GAMES
        if (of := found.get(name))
    ]
    return make_table("game | trajectories | rank correlation of energy and reward | p", lines)


# States that the encoder reads for each decision. Preset `paper` sees 26 states. It caches their
# tokens, except for the new state and the states whose stack now has black frames.
ENCODED = {"leapjax": 1, "paper": STACK}


def describe_encoding(row: Row) -> list[str]:
    """Formats the encoder's speed: states a second, GFLOP/s, and the fraction of the peak."""
    states = row["batch"] * ENCODED[row["preset"]] / row["encoding_seconds"]
    gflops = row["encoding_flops"] / row["encoding_seconds"] / 1e9
    peak = row.get("peak_gflops")  # missing in older rows
    return [f"{states:,.0f}", f"{gflops:.0f}", "-" if peak is None else f"{gflops / peak:.0%}"]


def compare_decisions(rows: Sequence[Row]) -> str:
    """Tabulates the parts of a decision in milliseconds, for games that are played together."""

    def milliseconds(part: str) -> Callable[[Row], str]:
        return lambda row: f"{1e3 * row[f'{part}_seconds']:.1f}"

    def rate(row: Row) -> str:
        return f"{row['batch'] / (row['planning_seconds'] + row['playing_seconds']):,.0f}"

    columns: Columns = {
        "preset": "`{preset}`",
        "games": "{batch}",
        "planner": milliseconds("planning"),
        "of it encoder": milliseconds("encoding"),
        "past encoded anew": milliseconds("anew"),
        "emulator": milliseconds("playing"),
        "decisions/s": rate,
        "states encoded/s": lambda row: describe_encoding(row)[0],
        "encoder GFLOP/s": lambda row: describe_encoding(row)[1],
        "of the peak": lambda row: describe_encoding(row)[2],
    }
    return list_rows(rows, columns)
