"""Which rows a table wants: a method with a preset, as it is today."""

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leapjax.configuration import change, configuration_hash
from leapjax.presets import find_preset
from leapjax.running.results import Row


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a column of the tables holds: a method with a preset, and what differs from that.

    Attributes:
        title: of the column.
        preset: by name.
        method: by name.
        changes: of the preset's configuration, see `leapjax.configuration.change`.
    """

    title: str
    preset: str
    method: str = "leap"
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def has(self, row: Row, **search: Any) -> bool:
        """Whether a row is of this setting as it is today, trained or played again.

        Args:
            row: any.
            search: fields of the planner's configuration that differ as well.
        """
        if (row["method"], row["preset"]) != (self.method, self.preset):
            return False
        planner = {**self.changes.get("planner", {}), **search}
        changes = json.dumps({**self.changes, "planner": planner}, sort_keys=True)
        of = row["domain"], row["level"], self.method, self.preset
        return row["hash"] in _hashes(*of, changes, row["seed"])


@functools.cache  # many rows are asked whether they are of the same settings
def _hashes(
    domain: str, level: str, method: str, preset: str, changes: str, seed: int
) -> tuple[str, str]:
    """The hashes of a configuration: of its training, and of its checkpoint played again.

    Args:
        domain: by name.
        level: by name.
        method: by name.
        preset: by name.
        changes: of the preset's configuration, as JSON: a key of the cache must be hashable.
        seed: of the training.
    """
    config = change(find_preset(domain, level, method, preset), **json.loads(changes))
    again = dataclasses.replace(config, checkpoint=Path())
    return configuration_hash(config, seed), configuration_hash(again, seed)


def of_setting(rows: Sequence[Row], setting: Setting, **search: Any) -> list[Row]:
    """The rows of a setting, one for each seed.

    Of two of one seed the one of the training, not the one of its checkpoint played again.
    """
    ordered = sorted(rows, key=lambda row: row["train_steps"] > 0)
    found = [row for row in ordered if setting.has(row, **search)]
    return list({row["seed"]: row for row in found}.values())
