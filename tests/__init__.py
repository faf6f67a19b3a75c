"""Sets XLA's flags and the folder of compiled programs before JAX is imported.

The first test or process that needs a program compiles it; the others load it.
"""

import os
import tempfile
from importlib.metadata import version

# Programs of tests take seconds to optimise and milliseconds to run. JAX 0.11 removed an option,
# and XLA ends the interpreter at an unknown flag.
QUICK: dict[str, bool | int] = {"xla_backend_optimization_level": 0}
if tuple(map(int, version("jax").split(".")[:2])) < (0, 11):
    QUICK["xla_cpu_use_fusion_emitters"] = False
FLAGS = {
    **QUICK, "xla_llvm_disable_expensive_passes": True, "xla_cpu_parallel_codegen_split_count": 1,
}  # fmt: skip
flags = " ".join(f"--{name}={str(value).lower()}" for name, value in FLAGS.items())
os.environ.setdefault("XLA_FLAGS", flags)
# Batches are split over several devices, as on a machine with several cores or GPUs.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "8")

OURS = None  # the folder of compiled programs, in the process that made it
if "LEAPJAX_COMPILATION_CACHE" not in os.environ:
    OURS = os.environ["LEAPJAX_COMPILATION_CACHE"] = tempfile.mkdtemp(prefix="leapjax-tests-")
