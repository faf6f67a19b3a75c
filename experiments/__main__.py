"""Runs a program of a checkout by name: `python -m experiments NAME`."""

import ast
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from leapjax.errors import did_you_mean
from leapjax.running import shell, startup

# In the order of `--help`, which shows the first line of each program's docstring.
PROGRAMS = (
    "babyai", "atari", "gymnasium", "stars", "sudoku", "countdown", "satisfiability", "properties",
    "stochastic", "suboptimal", "ablation", "noise", "demonstrator", "atari_energy", "landscape",
    "qualitative", "accuracy", "failures",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the program that the first argument names with the others; returns the exit code."""
    name, *rest = shell.read_arguments(arguments) or ["--help"]
    if name in ("-h", "--help"):
        command = startup.format_command("experiments.NAME")
        print(f"usage: {command} [OPTIONS]\n")
        print(f"{command} --help lists the options of a program; --version prints the version.\n")
        for each in PROGRAMS:
            # Importing all programs for their docstrings would take seconds.
            source = Path(__file__).with_name(f"{each}.py").read_text(encoding="utf-8")
            said = (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]
            print(f"  {each:12} {said.split(': `')[0]}")
        return 0
    if name not in PROGRAMS:
        expected = f"expected one of {', '.join(PROGRAMS)}{did_you_mean(name, PROGRAMS)}"
        print(f"error: unknown program {name!r}: {expected}", file=sys.stderr)
        return 2
    module = f"experiments.{name}"
    # The import fails, with one line, if an extra is missing.
    failed = shell.run_program(module, rest, lambda: importlib.import_module(module))
    return failed or importlib.import_module(module).main(rest)


if __name__ == "__main__":
    sys.exit(main())
