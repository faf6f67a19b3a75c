"""Starts and ends programs: a user's mistake prints one line, with exit code 2."""

import errno
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import jax

from leapjax.batching import NotANumber
from leapjax.errors import UserError, first_line
from leapjax.extras import report_missing
from leapjax.running import jax_setup, startup
from leapjax.running.interruption import Interrupted, Interruption, catch_signals
from leapjax.training import NonFiniteLoss

T = TypeVar("T")
FAILURES = (UserError, NotANumber, NonFiniteLoss)  # each ends one run, with an error of one line


def read_arguments(arguments: Sequence[str] | None) -> list[str]:
    """Returns the given arguments; by default the arguments of the process.

    Raises:
        SystemExit: a value is empty; prints an error of one line.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        check_values(given)
    except UserError as error:
        raise SystemExit(_report_failure(f"error: {error}", 2)) from None
    return given


def check_values(arguments: Sequence[str]) -> None:
    """Checks that no value is empty: a shell turns unset variables into empty values.

    Raises:
        UserError: a value is empty; names the option.
    """
    option = "an argument"
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name.startswith("--"):
            option = name
        if not (value if equals and name == option else argument).strip():
            raise UserError(f"{option} is empty: give it a value, or leave it out")


def parse(kind: type[T], module: str, arguments: Sequence[str], **options: Any) -> T:
    """Parses a command line; exits after --help, and with 2 if an option is wrong.

    Args:
        kind: dataclass of the options.
        module: module of the program, for usage lines.
        arguments: command line.
        options: further options of `tyro.cli`.
    """
    import tyro  # noqa: PLC0415  (`leapjax --help` needs no extra)

    return tyro.cli(kind, prog=startup.format_command(module), args=list(arguments), **options)


# The path is too long, leads through a file or a forbidden folder, or does not exist: the working
# folder may have been removed.
NAMED_WRONGLY = {errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.ENOENT}


def run_program(module: str, arguments: Sequence[str], work: Callable[[], object]) -> int:
    """Runs the work of a program, reports its errors, and returns the exit code.

    Args:
        module: module of the program.
        arguments: command line, which an interrupted program prints so that a user can continue.
        work: does the work.
    """
    try:
        with report_missing(startup.find_extra(module)):
            work()
    except Interrupted as stopped:
        stop(module, arguments, stopped)
    except UserError as error:
        return _report_failure(f"error: {describe(error)}", 2)
    except NotANumber as error:
        return _report_failure(f"error: {error}", 1)
    except NonFiniteLoss as error:
        return _report_failure(f"error: {error}; the last checkpoint is from before it", 1)
    except jax.errors.JaxRuntimeError as error:
        if not jax.distributed.is_initialized():
            raise
        reason = first_line(error)
        return _report_failure(
            f"error: the processes of this run have lost each other ({reason}): start all of them "
            "again, and they continue from the last checkpoint",
            1,
        )
    except KeyboardInterrupt:
        return _report_failure("stopped by Ctrl-C", 130)
    except OSError as error:
        if error.errno not in NAMED_WRONGLY:
            raise
        place = error.filename or "the working folder"
        return _report_failure(f"error: {error.strerror}: {place}", 2)
    return 0


def describe(error: Exception) -> str:
    """Returns the message of an error, with the options to change."""
    options = [f"--{name.replace('_', '-')}" for name in getattr(error, "fields", ())]
    return f"{error} ({', '.join(options)})" if options else str(error)


def run_interruptible_program(
    module: str, arguments: Sequence[str], work: Callable[[Interruption], object]
) -> int:
    """Runs long work as `run_program` does; SIGINT and SIGTERM stop it after saving."""

    def give_up(stopped: Interrupted) -> None:
        if not jax.distributed.is_initialized():  # the others would wait for this process
            stop(module, arguments, stopped)

    def interrupted_or_done() -> None:
        with catch_signals(give_up) as interruption:
            work(interruption)

    return run_program(module, arguments, interrupted_or_done)


def stop(module: str, arguments: Sequence[str], stopped: Interrupted) -> NoReturn:
    """Ends an interrupted program and prints the command that continues it."""
    command = " ".join([startup.format_command(module), *map(shlex.quote, arguments)])
    print(f"stopped by {stopped}; continue with: {command}", file=sys.stderr)
    # Exits at once: while the interpreter shuts down, threads that compile or write would crash.
    jax_setup.exit_at_once(stopped.exit_code)


def _report_failure(message: str, code: int) -> int:
    print(message, file=sys.stderr)
    return jax_setup.leave_program(code)
