"""Manifests, which list the games of a file with their seeds, noise and rules."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leapjax import files
from leapjax.domains.atari import replay
from leapjax.domains.atari.demonstrators import playing
from leapjax.domains.atari.games import Game
from leapjax.errors import UserError

Manifest = dict[str, Any]


def manifest_path(logs: Path, number: int) -> Path:
    """Returns the path of the manifest of a file."""
    return logs / f"manifest.{number}.json"


def read_manifest(
    folder: Path, game: Game, dqn_seed: int, number: int, longest: int | None = None
) -> Manifest | None:
    """Reads the manifest of a file; returns `None` if the file was not made here.

    Args:
        folder: folder of all games.
        game: expected game.
        dqn_seed: expected seed of the DQN.
        number: number of the file.
        longest: most decisions of a game. If given, checks that the file would have the same
            content if it were made now.

    Raises:
        UserError: the manifest is damaged, of another game or `dqn_seed`, or fails the check.
    """
    logs = replay.replay_logs(folder, game, dqn_seed)
    path = manifest_path(logs, number)
    if not path.exists() or not replay.has_shard(logs, number):
        return None
    try:
        manifest = json.loads(files.read_text(path))
        count_transitions([manifest])
        noises = [each["noise"] for each in manifest["games"]]
        of = manifest["game"], manifest.get("run", dqn_seed)
    except (ValueError, KeyError, TypeError, RecursionError):
        raise UserError(f"{path} is damaged: remove it, and its games are played again") from None
    if of != (game.name, dqn_seed):
        raise UserError(
            f"{logs} holds games of {of[0]}, seed {of[1]}, not of {game.name}, seed {dqn_seed}: "
            "give the folder its own name again, or name another one"
        )
    if longest is None:
        return manifest
    another = "remove them, or name another folder"
    found = manifest.get("longest", longest)
    if found != longest:
        raise UserError(
            f"{logs} holds games that were cut off after {found} decisions, not after {longest}: "
            f"{another}"
        )
    rules = playing.describe_rules(game)
    # Early manifests lack these keys; all demonstrators then had their first rules.
    played = {"demonstrator": rules["demonstrator"], "rules": 1} | {
        name: manifest[name] for name in rules if name in manifest
    }
    if played != rules:
        raise UserError(
            f"{logs} holds games of the demonstrator {played['demonstrator']} with rules "
            f"{played['rules']}, and today's is {rules['demonstrator']} with rules "
            f"{rules['rules']}: {another}"
        )
    if noises != [playing.choose_noise(game, number + index) for index in range(len(noises))]:
        raise UserError(
            f"{logs} holds games with other shares of random actions than today's demonstrators "
            f"have: {another}"
        )
    return manifest


def read_manifests(
    folder: Path,
    game: Game,
    dqn_seed: int,
    transitions: int,
    longest: int | None = None,
    before: Sequence[Manifest] = (),
) -> list[Manifest]:
    """Reads the manifests of consecutive files until they hold so many `transitions`.

    Args:
        folder: folder of all games.
        game: expected game.
        dqn_seed: expected seed of the DQN.
        transitions: number of transitions after which to stop.
        longest: see `read_manifest`.
        before: first manifests, if they were read already.
    """
    made = list(before)
    while count_transitions(made) < transitions:
        manifest = read_manifest(folder, game, dqn_seed, len(made), longest)
        if manifest is None:
            break
        made.append(manifest)
    return made


def count_transitions(manifests: Sequence[Manifest]) -> int:
    """Counts the transitions of files."""
    return sum(int(game["transitions"]) for each in manifests for game in each["games"])
