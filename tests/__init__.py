"""Toy runs of one configuration are compiled once, whichever test or process is the first."""

import os
import tempfile

OURS = None  # the folder of compiled programs, in the process that has made it
if "LEAPJAX_COMPILATION_CACHE" not in os.environ:
    OURS = os.environ["LEAPJAX_COMPILATION_CACHE"] = tempfile.mkdtemp(prefix="leapjax-tests-")
