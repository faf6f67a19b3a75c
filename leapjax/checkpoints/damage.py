"""Damaged checkpoints: detects them, describes them and sets them aside."""

import errno
import shutil
from pathlib import Path

from leapjax.errors import first_line

PASSING = {errno.EMFILE, errno.ENFILE, errno.EACCES, errno.EPERM, errno.ENOMEM}


def is_damage(error: Exception) -> bool:
    """Returns whether a failed read means damage, not a lack of memory, files or permission."""
    return not isinstance(error, MemoryError) and getattr(error, "errno", None) not in PASSING


def set_aside(checkpoint: Path) -> Path:
    """Renames a damaged checkpoint to `<step>.damaged` and returns the new path.

    Replaces an older folder of this name.
    """
    aside = checkpoint.with_name(f"{checkpoint.name}.damaged")
    shutil.rmtree(aside, ignore_errors=True)
    checkpoint.rename(aside)
    return aside


def describe_damage(checkpoint: Path, error: Exception) -> str:
    """Says in one line that a checkpoint cannot be read, and why."""
    return f"the checkpoint {checkpoint} cannot be read ({first_line(error)})"
