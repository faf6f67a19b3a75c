"""XLA's compilation cache, kept between runs: a second start takes seconds."""

import os
import platform
from pathlib import Path

import jax


def use_compilation_cache() -> None:
    """Keeps compiled programs in the user's cache folder.

    Programs are compiled for one processor, so each kind has its own folder.
    `LEAPJAX_COMPILATION_CACHE` names another folder, or is "off".
    """
    choice = os.environ.get("LEAPJAX_COMPILATION_CACHE", "")
    if choice == "off":
        return
    home = Path(os.environ.get("XDG_CACHE_HOME", "") or Path.home() / ".cache")
    folder = Path(choice) if choice else home / "leapjax" / "xla" / processor()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def processor() -> str:
    """A name for this kind of processor."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    names = {key.strip(): value.strip() for key, value in fields.items()}
    wanted = ("vendor_id", "cpu family", "model", "stepping", "model name")
    label = "-".join([model, *(names[key] for key in wanted if key in names)])
    return "".join(c if c.isalnum() or c in "-." else "_" for c in label)
