"""What comes before JAX: the flags of its compiler, and a folder for compiled programs.

Toy runs of one configuration are compiled once, whichever test or process is the first.
"""

import os
import tempfile
from importlib.metadata import version

# Programs of tests cost seconds to optimise and milliseconds to run. One of the options was removed
# in JAX 0.11, and XLA ends the interpreter at a flag that it does not know.
QUICK: dict[str, bool | int] = {"xla_backend_optimization_level": 0}
if tuple(map(int, version("jax").split(".")[:2])) < (0, 11):
    QUICK["xla_cpu_use_fusion_emitters"] = False
FLAGS = {
    **QUICK, "xla_llvm_disable_expensive_passes": True, "xla_cpu_parallel_codegen_split_count": 1,
}  # fmt: skip
flags = " ".join(f"--{name}={str(value).lower()}" for name, value in FLAGS.items())
os.environ.setdefault("XLA_FLAGS", flags)
# Several devices, as on a machine with several cores or GPUs: batches are split over them.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "8")

OURS = None  # the folder of compiled programs, in the process that has made it
if "LEAPJAX_COMPILATION_CACHE" not in os.environ:
    OURS = os.environ["LEAPJAX_COMPILATION_CACHE"] = tempfile.mkdtemp(prefix="leapjax-tests-")
