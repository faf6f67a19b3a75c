"""How JAX is set up for a program of ours: its devices, its compilation cache."""

import contextlib
import os
import platform
from pathlib import Path

import jax

MOST_CPU_DEVICES = 8  # of more, each would have too little of a batch to do


def start() -> None:
    """Every program's first step, before JAX has touched a device."""
    use_every_core()
    use_compilation_cache()


def use_every_core() -> None:
    """Makes each core a JAX device of its own, as `leapjax.sharding` wants them.

    `JAX_NUM_CPU_DEVICES`, if set, has the last word.
    """
    if "JAX_NUM_CPU_DEVICES" in os.environ:
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with contextlib.suppress(RuntimeError):  # JAX runs already: its devices are what they are
        jax.config.update("jax_num_cpu_devices", min(cores or 1, MOST_CPU_DEVICES))


def use_compilation_cache() -> None:
    """Keeps compiled programs in the user's cache folder: a second start takes seconds.

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
