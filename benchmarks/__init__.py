"""Programs that measure speed. They begin as those of `experiments` do, before JAX is imported."""

import experiments  # noqa: F401
