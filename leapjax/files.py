"""Files that are whole or not there, and folders that one process or one user has to itself."""

import contextlib
import os
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

from leapjax.errors import UserError, first_line

SPARE = 2**23  # bytes that are left free on every disk
LARGEST_TEXT = 2**26  # bytes of a file of text: more is not ours, and parsing takes many times that
CONTAINER_MEMORY = Path("/sys/fs/cgroup/memory.max")  # the limit of a container, on Linux

try:
    import fcntl
    import grp
    import pwd
except ImportError:  # not on Windows: there, nothing keeps two processes apart
    fcntl = None  # type: ignore[assignment]


def check_path(path: str | os.PathLike[str]) -> Path:
    """Returns a path under which the system can look for something, whether it is there or not.

    Raises:
        UserError: not a path, too long, holds a null byte, or leads into a folder that this user
            may not look into.
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
    """Reads a file of text.

    Args:
        path: of the file.
        most: the largest size allowed, in bytes.

    Raises:
        UserError: it cannot be read, is too large, or is not text.
    """
    try:
        _check_regular(path)
        with path.open("rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise ValueError(f"larger than {most >> 20} MiB")
        # As in text mode, line ends of other systems become our own.
        return data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {first_line(error)}") from None


def _check_regular(path: Path) -> None:
    """Refuses what is no file with an end: a pipe may never end, or never begin."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("not a file")


def read_sizes(path: Path) -> dict[str, int]:
    """Reads to how many bytes each array in a NumPy archive unpacks, and unpacks none.

    Raises:
        Exception: the archive is damaged (zipfile raises many kinds).
    """
    _check_regular(path)
    with zipfile.ZipFile(path) as archive:
        # Nobody reads more of a member than its size says.
        return {each.filename.removesuffix(".npy"): each.file_size for each in archive.infolist()}


def write_text(path: Path, text: str) -> None:
    """Writes a file so that a reader sees all of it or the one before.

    Raises:
        UserError: it cannot be written, for example because the disk is full.
    """
    with write_whole(path) as scratch:
        scratch.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def write_whole(path: Path) -> Iterator[Path]:
    """Gives a path to write to; what was written is at `path` afterwards, or nothing is.

    It is on the disk then, whatever happens to the power.

    Raises:
        UserError: it cannot be written, for example because the disk is full.
    """
    # The same suffix: what writes pictures goes by it.
    scratch = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.unlink(missing_ok=True)
        scratch.touch(exist_ok=False)  # ours: in a shared folder, not what another put there
        yield scratch
        flush(scratch)
        scratch.replace(path)
        flush(path.parent)
    except (OSError, ValueError) as error:  # ValueError: a suffix that names no kind of picture
        raise UserError(f"cannot write {path}: {first_line(error)}") from None
    finally:
        with contextlib.suppress(OSError):
            scratch.unlink(missing_ok=True)


def find_cache_folder() -> Path:
    """Returns the folder in which leapjax keeps what it can make again for this user.

    Raises:
        UserError: the system does not say where this user's files are.
    """
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        # A relative one is ignored, as the XDG specification has it.
        return (chosen if chosen.is_absolute() else Path.home() / ".cache") / "leapjax"
    except RuntimeError:
        raise UserError("this user has no home folder: name a folder in XDG_CACHE_HOME") from None


def make_private(folder: Path) -> None:
    """Makes a folder to which only this user can write; one that is there is checked.

    What is read from it again would otherwise be somebody else's choice.

    Raises:
        UserError: it cannot be made; or others can write to it, or put another in its place.
    """
    try:
        for path in (*reversed(folder.parents), folder):
            path.mkdir(mode=0o700, exist_ok=True)
        where = folder.resolve()
        _check_private(where, sticky=False)
        for parent in where.parents:
            _check_private(parent, sticky=True)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {first_line(error)}") from None


def _check_private(folder: Path, sticky: bool) -> None:
    """Refuses a folder to which others can write.

    Args:
        folder: to check.
        sticky: whether a sticky folder will do, in which nobody replaces what another owns.
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
    """Whether a group is this user's own, as systems make one for each user.

    By convention it has the number or the name of the user. The numbers differ where a group was
    made for something else before.
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
    """Refuses what is larger than the memory of this machine, or of the container that we are in.

    Args:
        needed: bytes, at least.
        what: needs them.

    Raises:
        UserError: says how much would be needed.
    """
    if not hasattr(os, "sysconf"):  # Windows does not say
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # no container, or "max"
        memory = min(memory, int(CONTAINER_MEMORY.read_text()))
    if needed > memory:
        raise UserError(
            f"{what}: at least {needed >> 30} GiB of memory would be needed, and this machine has "
            f"{memory >> 30}"
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
def lock_folder(folder: Path, wait: bool = False) -> Iterator[None]:
    """Keeps other processes out of a folder; the system lets go however the process ends.

    Args:
        folder: made if it is not there.
        wait: for another process to leave, instead of refusing.

    Raises:
        UserError: another process is in there, or the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Not a link: what it leads to would be emptied.
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
