"""Keeps compiled programs on disk, so that later processes load them."""

import functools
import os
import platform
import sys
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from leapjax import files
from leapjax.errors import UserError

CPU = Path("/proc/cpuinfo")  # on Linux
SHORTEST = 0.5  # seconds: programs that compile faster are not kept
SHORTEST_OF_JAX = 1.0  # JAX's own default


def use_disk_cache() -> None:
    """Keeps compiled programs in the user's cache folder: a second start takes seconds.

    Programs are compiled for one kind of processor, so each kind has its own folder. This process
    will run the programs in the folder. It therefore refuses a folder to which others can write,
    and says so once on stderr.

    JAX's settings stay as they are if JAX has a cache already (`jax_compilation_cache_dir`) or may
    not have a cache (`jax_enable_compilation_cache`). The environment variable
    `LEAPJAX_COMPILATION_CACHE` names another folder, or is "off".
    """
    config = jax.config
    kept: str | None = config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    allowed: bool = config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    choice = os.environ.get("LEAPJAX_COMPILATION_CACHE", "")
    if kept is not None or not allowed or choice == "off":
        return
    try:
        folder = Path(choice) if choice else files.find_cache_folder() / "xla" / name_processor()
        folder = files.make_private(folder.absolute())
    except UserError as error:  # JAX would print a traceback for every program
        _say_once(f"compiled programs are not kept: {error}")
        return
    config.update("jax_compilation_cache_dir", str(folder))
    shortest = config.jax_persistent_cache_min_compile_time_secs  # type: ignore[attr-defined]
    if shortest == SHORTEST_OF_JAX:
        config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    # JAX decides at its first compilation whether it has a cache: let it decide again.
    compilation_cache.reset_cache()


@functools.cache
def _say_once(line: str) -> None:
    print(line, file=sys.stderr)


def name_processor() -> str:
    """Returns a name for this kind of processor, fit for a folder."""
    model = platform.processor() or platform.machine()
    try:
        lines = CPU.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    names = {key.strip(): value.strip() for key, value in fields.items()}
    wanted = ("vendor_id", "cpu family", "model", "stepping", "model name")
    label = "-".join([model, *(names[key] for key in wanted if key in names)])
    return "".join(c if c.isalnum() or c in "-." else "_" for c in label)
