"""Damaged checkpoints: detects them, describes them and sets them aside."""

import errno
import re
import shutil
from pathlib import Path

from leapjax.errors import first_line

PASSING = {
    errno.EMFILE, errno.ENFILE, errno.EACCES, errno.EPERM, errno.ENOMEM, errno.EIO, errno.ESTALE,
}  # fmt: skip
# TensorStore raises ValueError, and names the number of the system's error in its message.
SYSTEM_ERROR = re.compile(r"os_error_code='(\d+)'")


def is_damage(error: Exception) -> bool:
    """Returns whether a failed read means damage, not a lack of memory, files or permission."""
    named = SYSTEM_ERROR.search(str(error))
    number = int(named[1]) if named else getattr(error, "errno", None)
    return not isinstance(error, MemoryError) and number not in PASSING


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
