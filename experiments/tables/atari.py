"""The Atari tables: scores, the data, energies against rewards, the price of a decision."""

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
# At the paper's scale, in what has been run of it; and with the temperature of preset `leapjax`.
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
    """Whether a row is in a table."""
    return any(setting.has(row) for setting in USED)


def compare_scores(rows: Sequence[Row], data: Mapping[str, Any]) -> str:
    """Scores of every method and game, 0 as random actions' and 100 as a gamer's; and as they are.

    With the standard error, and the mean score of the games that were learned from.
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
        found = {"paper": papers}
        found["ours"], found["score"] = _format_scores(rows, name, COLUMNS, few)
        found["ours, preset `paper`"], found["its score"] = _format_scores(rows, name, LARGE, many)
        found["the same, temperature 0.1"], found["that score"] = _format_scores(
            rows, name, COLD, many
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
    """By column: normalised scores, and as they are, of settings and of the games learned from."""
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
    """The mean score of rows, one for each seed, and its standard error.

    Of several seeds the larger of two: from the spread of their means, which a few seeds may
    happen to hide, and from that of the games alone. None where the best action is always taken:
    a game without sticky actions then depends on its no-ops modulo the frame skip alone, so that
    there are four, however many are played; and where a row is of one game.
    """
    means = np.array([row["mean_return"] for row in rows])
    errors = np.array([row.get("return_error") for row in rows], float)  # NaN of one game
    greedy = any(row["configuration"]["planner"].get("temperature") == 0 for row in rows)
    if greedy or np.isnan(errors).any():
        return float(means.mean()), None
    of_games = float(np.sqrt((errors**2).sum())) / len(rows)
    return float(means.mean()), max(scores.standard_error(means) or 0.0, of_games)


def _format_with_error(mean: float, error: float | None) -> str:
    return f"{mean:.1f}" if error is None else f"{mean:.1f} ± {error:.1f}"


def describe_data(found: Mapping[str, Any]) -> str:
    """What the demonstrators reached, whose games are learned from."""
    lines = []
    for game in GAMES:
        for name in sorted(each for each in found if parse_game(each) == game):
            lines.append([name, *_describe_reached(found[name])])
    return make_table("game | games | transitions | mean score | range | by random actions", lines)


def _describe_reached(games: Sequence[Mapping[str, Any]]) -> list[str]:
    """How many there are, and their scores."""
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
    """How energies of trajectories and their rewards are correlated."""
    lines = [
        [name, str(len(of["energies"])), f"{of['correlation']:.2f}", f"{of['p_value']:.1g}"]
        for name in GAMES
        if (of := found.get(name))
    ]
    return make_table("game | trajectories | rank correlation of energy and reward | p", lines)


# States that are encoded for a decision while playing. Of 26, preset `paper` reads the new one and
# those that see black frames before the context now; the tokens of the others it knows.
ENCODED = {"leapjax": 1, "paper": STACK}


def describe_encoding(row: Row) -> list[str]:
    """What is encoded while playing: states a second, GFLOP/s, their fraction of the peak."""
    states = row["batch"] * ENCODED[row["preset"]] / row["encoding_seconds"]
    gflops = row["encoding_flops"] / row["encoding_seconds"] / 1e9
    peak = row.get("peak_gflops")  # older rows have none
    return [f"{states:,.0f}", f"{gflops:.0f}", "-" if peak is None else f"{gflops / peak:.0%}"]


def compare_decisions(rows: Sequence[Row]) -> str:
    """What decisions are made of in games that are played together, in milliseconds."""

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
