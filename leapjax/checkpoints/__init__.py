"""Checkpoints: Orbax stores the arrays, and a seal ties them to their configuration.

Reading a checkpoint unpickles no object. The modules:

- `states` saves and restores the training states of a run.
- `parameters` saves and restores the parameters of a model alone.
- `sealing` checks that the numbers are intact and belong to the configuration.
- `contents` reads shapes without arrays.
- `damage` sets damaged checkpoints aside.
- `paths` checks the names of folders and lists their steps.
- `logs` drops the warnings of Orbax.
"""

from leapjax.checkpoints.logs import hush_orbax
from leapjax.checkpoints.parameters import (
    Unfinished,
    check_identity,
    restore_params,
    save_params,
)
from leapjax.checkpoints.paths import check_path
from leapjax.checkpoints.states import Checkpoints

__all__ = [
    "Checkpoints",
    "Unfinished",
    "check_identity",
    "check_path",
    "hush_orbax",
    "restore_params",
    "save_params",
]
