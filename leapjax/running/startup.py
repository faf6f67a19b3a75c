"""Prepares a program before it imports JAX: signals, output, --version, settings of JAX.

Imports only the standard library: importing JAX takes seconds.
"""

import contextlib
import io
import os
import signal
import sys
from pathlib import Path
from types import FrameType, TracebackType
from typing import NoReturn, TextIO

from leapjax.running.interruption import SIGNALS, Interrupted
from leapjax.version import find_version

COMMAND = "leapjax"  # the installed script
UNREAD = 128 + signal.SIGPIPE  # exit code after the reader of the output has gone


def is_program() -> bool:
    """Returns whether the interpreter is about to run a module of this package as a program.

    The name of the program is "-m" while `python -m` looks for a module and imports its packages.
    """
    return str(find_program()) == "-m" or find_program().stem == COMMAND


def find_program() -> Path:
    """Returns the path of the program that the interpreter runs, from `sys.argv`."""
    return Path(next(iter(getattr(sys, "argv", ())), ""))


def prepare() -> None:
    """Lets signals end the program at once, makes every text printable, and imports JAX.

    Exits with 0 after --version, which needs no JAX. Exits with 2, and one line, if JAX cannot be
    imported, for example because a setting is wrong.
    """
    for number in SIGNALS:
        signal.signal(number, end_on_signal)
    sys.stdout, sys.stderr = make_output(sys.stdout), make_output(sys.stderr)
    if "--version" in sys.argv[1:]:
        print(COMMAND, find_version())
        sys.exit(0)
    sys.unraisablehook = print_unraisable
    sys.excepthook = print_uncaught
    # Figures go to files. Matplotlib refuses an unknown backend with a traceback.
    os.environ["MPLBACKEND"] = "agg"
    try:
        import jax  # noqa: F401, PLC0415
    except Exception as error:  # noqa: BLE001  (each setting raises its own)
        message = f"error: cannot import JAX{list_jax_settings()}: {error or type(error).__name__}"
        print(" ".join(message.split()), file=sys.stderr)
        sys.exit(2)


class Output(io.TextIOWrapper):
    """A stream that ends the program when it cannot be written to.

    Its reader may have gone, as in `--help | head`, or the disk may be full. SIGPIPE ends other
    programs when a reader has gone. It would also end this program when a worker process or a
    logger has gone, instead of letting it report the failure.
    """

    def write(self, text: str) -> int:
        """Writes a text."""
        try:
            return super().write(text)
        except OSError as error:
            end_unwritten(error)

    def flush(self) -> None:
        """Flushes the buffer; the interpreter does so when it exits."""
        try:
            super().flush()
        except OSError as error:
            end_unwritten(error)


def make_output(stream: TextIO) -> TextIO:
    """Wraps a standard stream in `Output`, which replaces unencodable characters."""
    if not isinstance(stream, io.TextIOWrapper):  # `None`, or replaced by another library
        return stream
    return Output(
        stream.buffer, stream.encoding, "replace",
        line_buffering=stream.line_buffering, write_through=stream.write_through,
    )  # fmt: skip


def end_unwritten(error: OSError) -> NoReturn:
    """Ends the program: silently if its output has no reader, else with one line on stderr."""
    if isinstance(error, BrokenPipeError):
        os._exit(UNREAD)
    with contextlib.suppress(OSError):  # stderr may be on the same disk
        os.write(2, f"error: cannot write the output: {error.strerror}\n".encode())
    os._exit(1)


def format_command(module: str) -> str:
    """Returns the command of a program: `leapjax babyai`, or `python -m experiments.babyai`.

    Args:
        module: module of the program, such as "experiments.babyai".
    """
    package, _, name = module.partition(".")
    if find_program().stem == COMMAND:
        return f"{COMMAND} {name}"
    if find_program().parts[-2:] == (package, "__main__.py"):
        return f"python -m {package} {name}"
    return f"python -m {module}"


def find_modules_here() -> None:
    """Lets the installed command import from the working folder, as `python -m` does.

    Call it after importing `leapjax`, so that the folder cannot replace the installed package.
    """
    if find_program().stem == COMMAND and not sys.flags.safe_path:
        with contextlib.suppress(OSError):  # the working folder was removed
            sys.path.insert(0, str(Path.cwd()))


def end_on_signal(number: int, _: FrameType | None = None) -> None:
    """Handles signals until `catch_signals` does: prints one line, and ends the program.

    It must not raise: imports and callbacks of the interpreter may drop exceptions.
    """
    stopped = Interrupted(number)
    with contextlib.suppress(Exception):  # the buffer may be locked
        sys.stdout.flush()
    with contextlib.suppress(OSError):  # the reader has gone
        os.write(2, f"stopped by {stopped}\n".encode())
    os._exit(stopped.exit_code)


def print_unraisable(failure: "sys.UnraisableHookArgs") -> None:
    """Prints an exception that cannot be caught, unless a closed event loop raised it.

    If the disk is full, TensorStore reports to event loops that Orbax has closed already.
    """
    if failure.object is not None or str(failure.exc_value) != "Event loop is closed":
        sys.__unraisablehook__(failure)


def print_uncaught(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Prints an exception that ends the program; Python calls this hook.

    For a missing extra it prints one line and exits with 2: a program imports optional modules
    before its `main` can handle errors. It prints all other errors as Python does.
    """
    from leapjax.extras import explain_missing  # noqa: PLC0415  (imports JAX)

    spec = sys.modules["__main__"].__spec__  # `None` for the installed script
    explanation = explain_missing(error, find_extra(spec.name if spec else ""))
    if explanation is None:
        sys.__excepthook__(kind, error, trace)
        return
    print(f"error: {explanation}", file=sys.stderr)
    sys.exit(2)


def find_extra(module: str) -> str:
    """Returns the extra that a program needs, by its module, such as `experiments.atari`.

    A program named after a domain needs the domain's extra; other programs need BabyAI's.
    """
    from leapjax.domains import DOMAINS, Place  # noqa: PLC0415  (imports JAX)

    domain = DOMAINS.get(module.rpartition(".")[2].partition("_")[0])
    return domain.extra if isinstance(domain, Place) else "babyai"


def list_jax_settings() -> str:
    """Lists the settings of JAX and XLA in the environment, for a message."""
    given = [f"{name}={os.environ[name]}" for name in sorted(os.environ) if _is_setting(name)]
    return f" with {', '.join(given)}" if given else ""


def _is_setting(name: str) -> bool:
    return name.startswith("JAX_") or name == "XLA_FLAGS"
