"""Which rows a table wants: a method with a preset, as it is today."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.common.config import configuration_hash, with_options
from experiments.common.config import preset as config_of_preset
from experiments.common.results import Row


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


def of_setting(rows: Sequence[Row], setting: Setting, **options: Any) -> list[Row]:
    """The rows of a setting, one for each seed.

    Of two of one seed the one of the training, not the one of its checkpoint played again.
    """
    ordered = sorted(rows, key=lambda row: row["train_steps"] > 0)
    found = [row for row in ordered if setting.has(row, **options)]
    return list({row["seed"]: row for row in found}.values())
