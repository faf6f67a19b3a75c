"""Atomic file writes, locks and permissions of folders, and checks of disk and memory."""

import contextlib
import hashlib
import os
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

from leapjax.errors import UserError, first_line

SPARE = 2**23  # bytes that must stay free on a disk
LARGEST_TEXT = 2**26  # bytes: our text files are smaller, and parsing takes many times the size
CONTAINER_MEMORY = Path("/sys/fs/cgroup/memory.max")  # the limit of a container, on Linux

try:
    import fcntl
    import grp
    import pwd
except ImportError:  # Windows lacks these modules: no locks there
    fcntl = None  # type: ignore[assignment]


def check_path(path: str | os.PathLike[str]) -> Path:
    """Returns a path that the system can look up; the file need not exist.

    Raises:
        UserError: the value is not a path, is too long, holds a null byte, or leads into a folder
            that this user may not search.
    """
    try:
        found = Path(path)
        found.stat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except TypeError:
        raise UserError(f"expected a path, got {path!r}") from None
    except (OSError, ValueError) as error:
        shown = str(path) if len(str(path)) <= 80 else f"{str(path)[:77]}..."
        reason = getattr(error, "strerror", None) or first_line(error)
        raise UserError(f"cannot look for {shown}: {reason}") from None
    return found


def read_text(path: Path, most: int = LARGEST_TEXT) -> str:
    """Reads a text file.

    Args:
        path: path of the file.
        most: the largest size allowed, in bytes.

    Raises:
        UserError: the file cannot be read, is too large, or is not text.
    """
    try:
        _check_regular(path)
        with path.open("rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise ValueError(f"larger than {most >> 20} MiB")
        # As in text mode, every kind of line end becomes "\n".
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {first_line(error)}") from None


def describe(path: Path) -> str:
    """Returns the name of a file of text with a digest of its contents.

    Raises:
        UserError: the file cannot be read, is too large, or is not text.
    """
    return f"{path.name} {hashlib.sha256(read_text(path).encode()).hexdigest()[:12]}"


def _check_regular(path: Path) -> None:
    """Raises ValueError unless a path is a regular file: reading a pipe might block for ever."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("not a file")


def read_sizes(path: Path) -> dict[str, int]:
    """Returns the unpacked bytes of each array in a NumPy archive, without unpacking it.

    Raises:
        Exception: the archive is damaged (zipfile raises many kinds), or holds other things than
            arrays, or two of one name.
    """
    _check_regular(path)
    with zipfile.ZipFile(path) as archive:
        # Readers of the archive stop at the size that it claims for an array.
        found = [(each.filename, each.file_size) for each in archive.infolist()]
    sizes = {name.removesuffix(".npy"): size for name, size in found if name.endswith(".npy")}
    if len(sizes) < len(found):  # NumPy would read another entry than the one measured here
        raise ValueError("it holds two arrays of one name, or an entry that is no array")
    return sizes


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically: a reader sees the old text or the new text, never a part.

    Raises:
        UserError: the file cannot be written, for example because the disk is full.
    """
    with write_whole(path) as scratch:
        scratch.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def write_whole(path: Path) -> Iterator[Path]:
    """Yields a scratch path; the file written there replaces `path` when the block succeeds.

    By then the file is on the disk and survives a power failure.

    Raises:
        UserError: the file cannot be written, for example because the disk is full.
    """
    # Keeps the suffix, from which libraries choose the format of a picture.
    scratch = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.unlink(missing_ok=True)
        scratch.touch(exist_ok=False)  # fails if another user put a file there
        yield scratch
        flush(scratch)
        scratch.replace(path)
        flush(path.parent)
    except (OSError, ValueError) as error:  # ValueError: unknown picture suffix
        raise UserError(f"cannot write {path}: {first_line(error)}") from None
    finally:
        with contextlib.suppress(OSError):
            scratch.unlink(missing_ok=True)


def find_cache_folder() -> Path:
    """Returns this user's folder for files that leapjax can make again.

    Raises:
        UserError: XDG_CACHE_HOME names no absolute path, and this user has no home folder.
    """
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        # The XDG specification says to ignore a relative path.
        return (chosen if chosen.is_absolute() else Path.home() / ".cache") / "leapjax"
    except RuntimeError:
        raise UserError("this user has no home folder: name a folder in XDG_CACHE_HOME") from None


def make_private(folder: Path) -> Path:
    """Makes a folder to which only this user can write, or checks an existing folder.

    Otherwise another user could choose the files that this process reads from it.

    Returns:
        The absolute path without links: others may be able to replace a link.

    Raises:
        UserError: the folder cannot be made, or others can write to it or replace it.
    """
    try:
        for path in (*reversed(folder.parents), folder):
            path.mkdir(mode=0o700, exist_ok=True)
        where = folder.resolve()
        _check_private(where, sticky=False)
        for parent in where.parents:
            _check_private(parent, sticky=True)
        return where
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {first_line(error)}") from None


def _check_private(folder: Path, sticky: bool) -> None:
    """Raises UserError if another user owns a folder or can write to it.

    Args:
        folder: folder to check.
        sticky: whether to accept a sticky folder, in which users cannot replace each other's files.
    """
    if not hasattr(os, "getuid"):  # Windows keeps the folders of users apart
        return
    user, status = os.getuid(), folder.stat()
    if status.st_uid not in (user, 0):
        raise UserError(f"{folder} belongs to another user (uid {status.st_uid}): name another")
    mode = status.st_mode
    others = mode & stat.S_IWOTH or (mode & stat.S_IWGRP and not _is_own_group(status.st_gid))
    if others and not (sticky and mode & stat.S_ISVTX):
        raise UserError(f"others can write to {folder}: name another, or run chmod go-w on it")


def _is_own_group(group: int) -> bool:
    """Returns whether a group is the private group that the system made for this user.

    By convention it has the user's number or name. The numbers differ if an earlier group had
    taken the user's number.
    """
    user = os.getuid()
    if group == user:
        return True
    try:
        found, name = grp.getgrgid(group), pwd.getpwuid(user).pw_name
    except KeyError:
        return False
    return found.gr_name == name and set(found.gr_mem) <= {name}


def flush(path: Path) -> None:
    """Waits until a file, or a folder's list of files, is on the disk."""
    if path.is_dir() and not hasattr(os, "O_DIRECTORY"):  # Windows cannot flush a folder
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_room(folder: Path, needed: int) -> None:
    """Checks that the disk has room: other libraries may crash when it is full.

    Args:
        folder: folder to write to.
        needed: largest number of bytes to write; `SPARE` bytes must remain free.

    Raises:
        UserError: the disk lacks room; says how much is free and how much may be needed.
    """
    free = shutil.disk_usage(folder).free
    if free < needed + SPARE:
        raise UserError(
            f"{free >> 20} MiB are free in {folder}, and {(needed + SPARE) >> 20} may be needed: "
            "make room, or use another folder"
        )


def check_memory(needed: int, what: str) -> None:
    """Checks that this machine, or the container of this process, has enough memory.

    Args:
        needed: smallest number of bytes that the work takes.
        what: the work, or the options that enlarge it, for the error message.

    Raises:
        UserError: the memory is too small; says how much is needed.
    """
    if not hasattr(os, "sysconf"):  # Windows
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # no container, or no limit ("max")
        memory = min(memory, int(CONTAINER_MEMORY.read_text()))
    if needed > memory:
        raise UserError(
            f"{what}: at least {needed >> 30} GiB of memory would be needed, and this machine has "
            f"{memory >> 30}"
        )


def check_writable(folder: Path) -> None:
    """Checks that files can be made in a folder, which need not exist yet.

    Raises:
        UserError: the folder cannot be made or written to.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        reason = error.strerror or first_line(error)  # not with the name of the temporary file
        raise UserError(f"cannot write to {folder}: {reason}") from None


@contextlib.contextmanager
def lock_folder(folder: Path, wait: bool = False) -> Iterator[None]:
    """Locks a folder inside the block; the system releases the lock even of a killed process.

    Args:
        folder: folder to lock; made if it does not exist.
        wait: whether to wait while another process holds the lock, instead of raising.

    Raises:
        UserError: another process holds the lock, or the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # O_NOFOLLOW: the file is emptied below, which must not happen to a link's target.
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)
        file = os.fdopen(os.open(folder / ".lock", flags, 0o666), "ab+", buffering=0)
    except (OSError, ValueError) as error:  # ValueError: a null byte
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
