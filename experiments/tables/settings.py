"""Selects the rows of a table: a method with a preset, with today's settings."""

import dataclasses
import functools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from leapjax.configuration import change, hash_config
from leapjax.presets import find_preset
from leapjax.running.results import Row

Key = TypeVar("Key")


@dataclasses.dataclass(frozen=True)
class Setting:
    """A method with a preset and changes of it: a column of a table.

    Attributes:
        preset: name of the preset.
        method: name of the method.
        changes: changes of the preset's configuration, see `leapjax.configuration.change`.
    """

    preset: str
    method: str = "leap"
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def searching(self, **search: Any) -> "Setting":
        """Returns this setting with other fields of the planner's configuration."""
        planner = {**self.changes.get("planner", {}), **search}
        return dataclasses.replace(self, changes={**self.changes, "planner": planner})

    def has(self, row: Row) -> bool:
        """Tells whether a row has this setting's hash today, from training or from a checkpoint."""
        if (row["method"], row["preset"]) != (self.method, self.preset):
            return False
        of = row["domain"], row["level"], self.method, self.preset
        return row["hash"] in _hash_setting(
            *of, json.dumps(self.changes, sort_keys=True), row["seed"]
        )


@functools.cache  # called once for each row and setting
def _hash_setting(
    domain: str, level: str, method: str, preset: str, changes: str, seed: int
) -> tuple[str, str]:
    """Returns two hashes of a configuration: for its training, and for its checkpoint played again.

    `changes` is JSON, because the cache needs a hashable key.
    """
    config = change(find_preset(domain, level, method, preset), **json.loads(changes))
    again = dataclasses.replace(config, checkpoint=Path())
    return hash_config(config, seed), hash_config(again, seed)


def select(
    rows: Sequence[Row], levels: Iterable[str], settings: Mapping[Key, Setting]
) -> dict[tuple[str, Key], list[Row]]:
    """Groups rows by level and setting, one for each seed.

    If a seed has a row of the training and a row of its checkpoint played again, takes the row of
    the training. Every level and setting has a group, which may be empty.
    """
    ordered = sorted(rows, key=lambda row: row["train_steps"] > 0)
    by_level = {level: [row for row in ordered if row["level"] == level] for level in levels}
    return {
        (level, key): list({row["seed"]: row for row in of if setting.has(row)}.values())
        for level, of in by_level.items()
        for key, setting in settings.items()
    }
