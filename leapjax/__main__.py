"""Trains a planner, plays it and records the results: `leapjax DOMAIN`."""

import sys
from collections.abc import Sequence
from importlib import import_module

from leapjax.running import startup

if __name__ == "__main__" or startup.is_program():
    startup.prepare()

USAGE = """usage: leapjax DOMAIN [OPTIONS]

leapjax DOMAIN --help lists the options; --version prints the version.

{domains}

A checkout has more programs, which reproduce the tables of the paper: python -m experiments"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Trains and plays a planner in a domain; returns the exit code."""
    from leapjax.domains import DOMAINS, Place  # noqa: PLC0415  (all of these import JAX)
    from leapjax.errors import did_you_mean  # noqa: PLC0415
    from leapjax.running import shell  # noqa: PLC0415

    startup.find_modules_here()
    name, *rest = shell.read_arguments(arguments) or ["--help"]
    if name in ("-h", "--help"):
        about = {name: d.about for name, d in DOMAINS.items() if isinstance(d, Place)}
        print(USAGE.format(domains="\n".join(f"  {n:12} {text}" for n, text in about.items())))
        return 0
    if name not in DOMAINS:
        expected = f"expected one of {', '.join(DOMAINS)}{did_you_mean(name, DOMAINS)}"
        print(f"error: unknown domain {name!r}: {expected}", file=sys.stderr)
        return 2
    # This import fails if an extra is missing.
    failed = shell.run_program(
        f"leapjax.{name}", rest, lambda: import_module("leapjax.running.main")
    )
    return failed or _run(name, rest)


def _run(domain: str, arguments: Sequence[str]) -> int:
    """Runs the command line of a domain; returns the exit code."""
    from leapjax.configuration import Config  # noqa: PLC0415  (it needs an extra)
    from leapjax.running import main as running  # noqa: PLC0415  (also)
    from leapjax.running.run import Experiment  # noqa: PLC0415  (also)
    from leapjax.running.spelling import SPELLINGS  # noqa: PLC0415  (also)

    config = SPELLINGS.get(domain, Config)
    return running.main(Experiment(domain, domain, config=config, package="leapjax"), arguments)


if __name__ == "__main__":
    sys.exit(main())
