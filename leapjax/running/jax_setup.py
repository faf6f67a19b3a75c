"""Sets up JAX for a program: its settings, devices and compilation cache."""

import contextlib
import enum
import os
import signal
import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import jax

from leapjax import compilation
from leapjax.errors import UserError, first_line
from leapjax.processes import Cluster
from leapjax.running import startup

MOST_CPU_DEVICES = 8  # with more devices, each would get too small a share of a batch
MOST_ASKED_FOR = 1024  # CPU devices; JAX takes half a minute to make 4,000
CONNECT_SECONDS = 120
# Variables with the number of processes that srun or mpirun has started. A batch script that starts
# a single process has SLURM_NTASKS too, so that variable would not do.
LAUNCHED = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")


class Promise(NamedTuple):
    """A setting of JAX that a promise of this library depends on.

    Attributes:
        setting: name of the setting.
        allowed: values that keep the promise.
        why: the promise, or what other values would break.
    """

    setting: str
    allowed: Sequence[Any]
    why: str


_DRAWS = "what a seed draws would be something else"
_STEPS = "leapjax traces, compiles and runs its programs itself"
_TYPES = "leapjax mixes types and ranks as NumPy does"
# Settings that only report, slow down or tune the compiler are not here.
PROMISES = (
    Promise("jax_enable_x64", (False,), "leapjax computes in 32 bits"),
    Promise("jax_explicit_x64_dtypes", ("warn",), "leapjax computes in 32 bits"),
    Promise("jax_default_matmul_precision", (None,), "a resumed run would end with other bits"),
    Promise("jax_softmax_custom_jvp", (False,), "a resumed run would end with other bits"),
    Promise("jax_default_prng_impl", ("threefry2x32",), _DRAWS),
    Promise("jax_threefry_partitionable", (True,), _DRAWS),
    Promise("jax_random_seed_offset", (0,), _DRAWS),
    Promise("jax_high_dynamic_range_gumbel", (False,), _DRAWS),
    Promise("jax_disable_jit", (False,), _STEPS),
    Promise("jax_no_tracing", (False,), _STEPS),
    Promise("jax_no_execution", (False,), _STEPS),
    Promise("jax_allow_f16_reductions", (True,), "networks with --dtype bfloat16 need them"),
    Promise("jax_numpy_dtype_promotion", ("standard",), _TYPES),
    Promise("jax_numpy_rank_promotion", ("allow", "warn"), _TYPES),
    Promise("jax_debug_infs", (False,), "masked logits and energies of partial plans are infinite"),
    Promise("jax_default_device", (None,), "leapjax places batches on every device itself"),
    *(
        Promise(
            f"jax_transfer_guard{direction}", (None, "allow", "log", "log_explicit"),
            "leapjax moves data to and from the devices",
        )
        for direction in ("", "_host_to_device", "_device_to_device", "_device_to_host")
    ),
)  # fmt: skip


ALONE = Cluster()  # one process


def start(cluster: Cluster = ALONE, cache: bool = True) -> None:
    """Sets up JAX; a program calls it before JAX uses a device.

    Args:
        cluster: the processes that share the run.
        cache: whether to keep compiled programs on disk; False to measure compilation.

    Raises:
        UserError: a setting of JAX breaks a promise, the other processes cannot be reached, or
            JAX has no usable device.
    """
    check_promises()
    use_every_core()
    if cache:
        compilation.use_disk_cache()
    else:
        jax.config.update("jax_enable_compilation_cache", False)
    connect(cluster)
    check_devices()


def check_promises() -> None:
    """Checks the settings of JAX that promises of this library depend on.

    Raises:
        UserError: a setting breaks a promise.
    """
    for setting, allowed, why in PROMISES:
        value = getattr(jax.config, setting, allowed[0])  # some versions lack some settings
        value = value.name.lower() if isinstance(value, enum.Enum) else value
        if value not in allowed:
            raise UserError(
                f"JAX's setting {setting} is {value!r}: {why}; unset {setting.upper()}, or use "
                f"{' or '.join(map(repr, allowed))}"
            )


def check_devices() -> None:
    """Starts JAX, unless it has started.

    Raises:
        UserError: JAX has no device, for example because of JAX_PLATFORMS=cuda without a GPU.
    """
    try:
        jax.devices()
    except Exception as error:  # noqa: BLE001  (each platform raises its own)
        raise UserError(
            f"JAX can use no device{startup.list_jax_settings()} ({first_line(error)}): change "
            "these settings, or install what they need"
        ) from None


def connect(cluster: Cluster) -> None:
    """Joins the other processes of a run, if there are others.

    Raises:
        UserError: the other processes cannot be reached.
    """
    launched = any(_read_count(os.environ.get(name, "")) > 1 for name in LAUNCHED)
    if cluster.coordinator is None and not launched:
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        jax.distributed.initialize(
            cluster.coordinator, cluster.num_processes, cluster.process_id,
            initialization_timeout=CONNECT_SECONDS,
        )  # fmt: skip
        for number, handler in handlers.items():  # JAX takes SIGTERM for itself
            if handler is not None:
                signal.signal(number, handler)
    except Exception as error:  # noqa: BLE001  (gRPC and JAX raise many kinds)
        raise UserError(
            f"cannot join the other processes of this run ({first_line(error)}): check that all "
            "were started, and that process 0 can be reached at --coordinator"
        ) from None


def _read_count(text: str) -> int:
    """Returns a number of processes from its text; 1 if the text is not a number."""
    return int(text) if text.strip().isdecimal() else 1


def leave_program(code: int) -> int:
    """Returns the exit code of a program that ends early; a run of several processes exits here.

    JAX would wait minutes for the other processes, which wait for this process. Process 0 ends
    last: without it JAX aborts the others before they can print their errors.
    """
    if jax.distributed.is_initialized():
        exit_at_once(code)
    return code


def exit_at_once(code: int) -> NoReturn:
    """Ends the program without the cleanup of the interpreter."""
    sys.stdout.flush()
    sys.stderr.flush()
    if jax.distributed.is_initialized():
        time.sleep(5 if jax.process_index() == 0 else 1)
    os._exit(code)


def use_every_core() -> None:
    """Makes each core a JAX device of its own, as `leapjax.sharding` expects.

    `JAX_NUM_CPU_DEVICES` overrides this, if it is set.

    Raises:
        UserError: JAX cannot make that number of devices.
    """
    if "JAX_NUM_CPU_DEVICES" in os.environ:
        asked: int = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
        if asked != -1 and not 1 <= asked <= MOST_ASKED_FOR:  # -1: JAX's own default
            raise UserError(
                f"JAX_NUM_CPU_DEVICES is {asked}: expected a number in 1 .. {MOST_ASKED_FOR}"
            )
        return
    with contextlib.suppress(RuntimeError):  # JAX has started: its devices are fixed
        jax.config.update("jax_num_cpu_devices", min(count_cores(), MOST_CPU_DEVICES))


def count_cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
