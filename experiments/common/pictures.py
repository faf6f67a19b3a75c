"""Animations."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from leapjax import files

Frame = tuple[Image.Image, int]  # a picture, and for how many milliseconds it is shown


def save_animation(frames: Sequence[Frame], path: Path) -> None:
    """Writes frames as a GIF that repeats, atomically."""
    first, *others = [image for image, _ in frames]
    with files.whole(path) as scratch:
        first.save(
            scratch, save_all=True, append_images=others, loop=0, optimize=True,
            duration=[milliseconds for _, milliseconds in frames],
        )  # fmt: skip
