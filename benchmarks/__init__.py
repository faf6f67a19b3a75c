"""Programs that measure speed. Importing `experiments` first prepares the process for JAX."""

import experiments  # noqa: F401
