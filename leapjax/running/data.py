"""Makes, reads and notes the demonstrations that a run learns from."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from leapjax import files, processes
from leapjax.agents.measured import needs_data
from leapjax.agents.returns import sum_rewards
from leapjax.data import seeds, storage
from leapjax.data.storage import describe_dropped
from leapjax.domain import Domain, Source
from leapjax.environments import judge_episode
from leapjax.errors import UserError
from leapjax.methods import learns_from_rewards
from leapjax.running.progress import Meter
from leapjax.running.run import Run
from leapjax.serialization import read_json
from leapjax.types import Demonstration

DATA = "data.json"  # in the folder of a run: the demonstrations that it learns from


def load_demonstrations(run: Run) -> list[Demonstration]:
    """Reads the demonstrations to train on: the user's, or the domain's own.

    Raises:
        UserError: the demonstrations cannot be made or read, are fewer than asked for, lack the
            rewards that the method learns from, or come from levels that measure success.
    """
    config = run.config
    if not config.demos:
        return []
    source = storage.find_source(run.domain, config.demos, run.seed)
    name = config.demonstrations or source.default
    begun = time.perf_counter()
    if config.demonstrations is None and processes.run_on_first(lambda: not source.exists(name)):
        # Otherwise the programs depend on the data.
        if run.domain.scaling.measure is None and not needs_data(config.method_settings):
            run.programs.begin(run)
        processes.run_on_first(lambda: _make(run, source, name))
    # Each process reads its own copy: the data need not be on a shared disk.
    loaded = processes.run_together(lambda: source.load(name, run.seed))
    data, dropped = loaded.demonstrations[: config.demos], describe_dropped(loaded)
    run.seconds["demos"] += time.perf_counter() - begun
    if dropped:
        run.console.print(f"{len(data)} episodes of {name}; dropped: {dropped}", highlight=False)
    asked = learns_from_rewards(config.method, config.method_settings)
    if asked and not any(d.rewards.any() for d in data):
        raise UserError(
            f"{name} holds no rewards, from which --method {config.method} learns: give it data "
            "with rewards, or another method"
        )
    seeds.check_disjoint([d.seed for d in data], run.played)
    return data


def _make(run: Run, source: Source, name: str) -> None:
    """Makes the demonstrations of a source."""
    with Meter(run.console, source.unit, source.amount) as meter:
        summary = source.make(name, meter.update)
    run.console.print(summary)


def judge_data(data: Sequence[Demonstration], domain: Domain) -> dict[str, Any] | None:
    """Returns success rate and mean return of demonstrations, by the criterion of the domain.

    Returns `None` if the environment judges success itself: demonstrations do not store that.
    """
    criterion = domain.demonstrations.criterion
    if criterion is None or not data:
        return None
    totals = sum_rewards(data)
    successes = [
        judge_episode(criterion, total, float(d.rewards[-1]), d.terminated, d.truncated)
        for total, d in zip(totals, data, strict=True)
    ]
    return {"success": float(np.mean(successes)), "return": float(np.mean(totals))}


def read_outcome(folder: Path) -> tuple[float, float] | None:
    """Returns success rate and mean return of a run's demonstrations; `None` without a note."""
    found = _read_note(folder).get("outcome") if (folder / DATA).exists() else None
    values = [found.get(name) for name in ("success", "return")] if isinstance(found, dict) else []
    numbers = [float(each) for each in values if isinstance(each, float) and math.isfinite(each)]
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


def check_data(
    folder: Path,
    fingerprint: str,
    level_seeds: Sequence[int],
    outcome: Mapping[str, Any] | None = None,
) -> None:
    """Checks that a run continues on the demonstrations that it began with.

    The first call notes their fingerprint, their level seeds for `find_demonstrated`, and their
    outcome for `read_outcome`.

    Raises:
        UserError: the run began with other demonstrations, or the processes have read different
            demonstrations.
    """
    if len(set(processes.gather(fingerprint))) > 1:
        raise UserError(
            "the processes have different demonstrations: copy one data set to all machines, or "
            "put MINARI_DATASETS_PATH on a shared disk"
        )

    def check() -> None:
        if not (folder / DATA).exists():
            noted: dict[str, Any] = {"fingerprint": fingerprint, "seeds": list(level_seeds)}
            noted |= {} if outcome is None else {"outcome": outcome}
            return files.write_text(folder / DATA, json.dumps(noted))
        before = _read_note(folder).get("fingerprint")
        if before != fingerprint:
            raise UserError(
                f"{folder} was begun on other demonstrations ({before}, now {fingerprint}): "
                "remove it to begin again, or give this run another --runs folder"
            )
        return None

    processes.run_on_first(check)


def find_demonstrated(folder: Path) -> list[int]:
    """Returns the level seeds of a run's demonstrations; [] if its folder has no note of them."""
    found = _read_note(folder).get("seeds") if (folder / DATA).exists() else None
    return [seed for seed in found if isinstance(seed, int)] if isinstance(found, list) else []


def _read_note(folder: Path) -> dict[str, Any]:
    """Reads the note of `check_data`; returns {} if the note is not an object."""
    values = read_json(folder / DATA)
    return values if isinstance(values, dict) else {}
