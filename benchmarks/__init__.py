"""Programs that measure speed. `experiments` prepares the process before JAX is imported."""

import experiments  # noqa: F401
