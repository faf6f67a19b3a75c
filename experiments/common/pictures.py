"""Writes pictures: animations, and sheets of several."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from leapjax import files
from leapjax.errors import UserError

Frame = tuple[Image.Image, int]  # a picture and its duration in milliseconds


def save_animation(frames: Sequence[Frame], path: Path) -> None:
    """Writes frames as a GIF that repeats, atomically."""
    first, *others = [image for image, _ in frames]
    with files.write_whole(path) as scratch:
        first.save(
            scratch, save_all=True, append_images=others, loop=0, optimize=True,
            duration=[milliseconds for _, milliseconds in frames],
        )  # fmt: skip


def save_sheet(pictures: Sequence[Image.Image], columns: int, path: Path) -> None:
    """Writes pictures of one size side by side, at most `columns` in a row, atomically."""
    width, height = pictures[0].size
    columns = min(columns, len(pictures))
    sheet = Image.new("RGB", (width * columns, height * -(-len(pictures) // columns)), "white")
    for index, picture in enumerate(pictures):
        sheet.paste(picture, (width * (index % columns), height * (index // columns)))
    with files.write_whole(path) as scratch:
        sheet.save(scratch)


def check_picture(path: Path) -> None:
    """Checks, before long work, that a picture can be written.

    Raises:
        UserError: the file's suffix is unknown, or its folder is not writable.
    """
    if path.suffix.lower() not in Image.registered_extensions():
        raise UserError(f"{path}: a picture can be .png or .gif, among others")
    files.check_writable(path.parent)
