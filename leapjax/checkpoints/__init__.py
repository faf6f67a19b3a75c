"""Checkpoints: Orbax stores the arrays, a seal says whose they are. Nothing is ever unpickled.

`states` saves and restores the training states of a run, `parameters` those of a model alone.
`sealing` checks that the numbers are intact and belong to the configuration, `contents` reads
shapes without arrays, `damage` sets damaged checkpoints aside, `paths` names folders and steps.
"""

from leapjax.checkpoints.logs import hush_orbax
from leapjax.checkpoints.parameters import (
    Unfinished,
    check_identity,
    restore_params,
    save_params,
)
from leapjax.checkpoints.paths import check_path, find_newest
from leapjax.checkpoints.states import Checkpoints

__all__ = [
    "Checkpoints",
    "Unfinished",
    "check_identity",
    "check_path",
    "find_newest",
    "hush_orbax",
    "restore_params",
    "save_params",
]
