"""Which rows a table wants: a method with a preset, as it is today."""

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
    """A method with a preset, and what differs from it: a column of a table.

    Attributes:
        preset: by name.
        method: by name.
        changes: of the preset's configuration, see `leapjax.configuration.change`.
    """

    preset: str
    method: str = "leap"
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def searching(self, **search: Any) -> "Setting":
        """Returns this setting with other fields of the planner's configuration."""
        planner = {**self.changes.get("planner", {}), **search}
        return dataclasses.replace(self, changes={**self.changes, "planner": planner})

    def has(self, row: Row) -> bool:
        """Tells whether a row is of this setting as it is today, trained or played again."""
        if (row["method"], row["preset"]) != (self.method, self.preset):
            return False
        of = row["domain"], row["level"], self.method, self.preset
        return row["hash"] in _hash_setting(
            *of, json.dumps(self.changes, sort_keys=True), row["seed"]
        )


@functools.cache  # many rows are asked whether they are of the same settings
def _hash_setting(
    domain: str, level: str, method: str, preset: str, changes: str, seed: int
) -> tuple[str, str]:
    """Returns the hashes of a configuration: of its training, and of its checkpoint played again.

    `changes` is JSON: a key of the cache must be hashable.
    """
    config = change(find_preset(domain, level, method, preset), **json.loads(changes))
    again = dataclasses.replace(config, checkpoint=Path())
    return hash_config(config, seed), hash_config(again, seed)


def select(
    rows: Sequence[Row], levels: Iterable[str], settings: Mapping[Key, Setting]
) -> dict[tuple[str, Key], list[Row]]:
    """Groups rows by level and setting, one for each seed.

    Of two rows of one seed it takes the one of the training, not the one of its checkpoint played
    again. Every level and setting has a group, which may be empty.
    """
    ordered = sorted(rows, key=lambda row: row["train_steps"] > 0)
    by_level = {level: [row for row in ordered if row["level"] == level] for level in levels}
    return {
        (level, key): list({row["seed"]: row for row in of if setting.has(row)}.values())
        for level, of in by_level.items()
        for key, setting in settings.items()
    }
