"""Checks the names of folders of checkpoints, and lists the steps in them."""

import glob
from pathlib import Path

import tensorstore

from leapjax import files
from leapjax.errors import UserError, first_line


def check_path(folder: Path) -> None:
    """Checks that TensorStore and Orbax read the name of a folder literally.

    Raises:
        UserError: they read another name, and so would not find the checkpoints; says how.
    """
    path = str(to_absolute(files.check_path(folder)))
    try:  # TensorStore turns a backslash into a slash
        spec = tensorstore.KvStore.Spec({"driver": "file", "path": f"{path}/"})
        written = spec.to_json()["path"].removesuffix("/")
    except Exception as error:  # noqa: BLE001  (TensorStore raises many kinds)
        written = first_line(error)
    if written != path:
        taken = f"TensorStore takes it for {written}"
    elif glob.escape(path) != path:
        taken = "Orbax takes it for a pattern, with '*', '?' or '['"
    elif ":/" in path:
        taken = "Orbax takes it for an address, with ':/'"
    else:
        return
    raise UserError(f"{path} cannot hold checkpoints ({taken}): choose another folder")


def find_newest(folder: Path) -> list[int]:
    """Returns the steps of the checkpoints in a folder, the newest first.

    Raises:
        UserError: the folder cannot hold checkpoints, or cannot be read.
    """
    check_path(folder)
    if not folder.is_dir():
        return []
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError as error:
        raise UserError(f"cannot read {folder}: {first_line(error)}") from None
    # `isdecimal` alone would accept digits of every script, and names of any length.
    steps = [int(name) for name in names if name.isascii() and name.isdecimal() and len(name) < 20]
    return sorted(steps, reverse=True)


def to_absolute(folder: Path) -> Path:
    """Returns the absolute path of a folder, without "..", which TensorStore cannot read."""
    return folder.resolve() if ".." in folder.parts else folder.absolute()
