"""Files that are whole or not there, and folders that one process has to itself."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from leapjax.errors import UserError, first_line

SPARE = 2**23  # bytes that are left free on every disk

try:
    import fcntl
except ImportError:  # not on Windows: there, nothing keeps two processes apart
    fcntl = None  # type: ignore[assignment]


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        UserError: it cannot be read, or is not text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {first_line(error)}") from None


def write_text(path: Path, text: str) -> None:
    """Writes a file so that a reader sees all of it or the one before.

    Raises:
        UserError: it cannot be written, for example because the disk is full.
    """
    with whole(path) as scratch:
        scratch.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Gives a path to write to; what was written is at `path` afterwards, or nothing is.

    It is on the disk then, whatever happens to the power.

    Raises:
        UserError: it cannot be written, for example because the disk is full.
    """
    # The same suffix: what writes pictures goes by it.
    scratch = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
        flush(scratch)
        scratch.replace(path)
        flush(path.parent)
    except (OSError, ValueError) as error:  # ValueError: a suffix that names no kind of picture
        raise UserError(f"cannot write {path}: {first_line(error)}") from None
    finally:
        with contextlib.suppress(OSError):
            scratch.unlink(missing_ok=True)


def flush(path: Path) -> None:
    """Waits until a file, or what a folder says of its files, is on the disk."""
    if path.is_dir() and not hasattr(os, "O_DIRECTORY"):  # Windows has no way to
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_room(folder: Path, needed: int) -> None:
    """Refuses to begin what the disk has no room for: other libraries may crash there.

    Args:
        folder: to be written to.
        needed: bytes, at most; as many again as `SPARE` must be free.

    Raises:
        UserError: says how much is free, and how much would be needed.
    """
    free = shutil.disk_usage(folder).free
    if free < needed + SPARE:
        raise UserError(
            f"{free >> 20} MiB are free in {folder}, and {(needed + SPARE) >> 20} may be needed: "
            "make room, or use another folder"
        )


def check_memory(needed: int, what: str) -> None:
    """Refuses what is larger than the memory of this machine, where the system says how much it is.

    Args:
        needed: bytes, at least.
        what: needs them.

    Raises:
        UserError: says how much would be needed.
    """
    if not hasattr(os, "sysconf"):  # Windows does not say
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > memory:
        raise UserError(
            f"{what} would need {needed / 2**30:.1f} GiB of memory at least, and this machine has "
            f"{memory / 2**30:.1f}"
        )


def check_writable(folder: Path) -> None:
    """Refuses a folder in which no file could be made, whether it is there already or not.

    Raises:
        UserError: it could not be made, or nothing can be written there.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {first_line(error)}") from None


@contextlib.contextmanager
def only_process_in(folder: Path, wait: bool = False) -> Iterator[None]:
    """Keeps other processes out of a folder; the system lets go however the process ends.

    Args:
        folder: made if it is not there.
        wait: for another process to leave, instead of refusing.

    Raises:
        UserError: another process is in there, or the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".lock").open("ab+", buffering=0)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {first_line(error)}") from None
    with file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except OSError:
                file.seek(0)
                owner = file.read().decode(errors="replace").strip() or "unknown"
                raise UserError(
                    f"{folder} is in use by another process ({owner}): wait for it, stop it, or "
                    "name another folder"
                ) from None
        with contextlib.suppress(OSError):  # a full disk: the lock itself takes no room
            file.truncate(0)
            file.write(f"{os.getpid()}\n".encode())
        yield
