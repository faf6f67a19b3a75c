"""Where a program begins and ends: a user's mistake is one line and exit code 2."""

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
FAILURES = (UserError, NotANumber, NonFiniteLoss)  # that end one run, and can be said in one line


def read_arguments(arguments: Sequence[str] | None) -> list[str]:
    """The command line of a program: what was given, or the real one.

    Raises:
        SystemExit: a value is empty; it is said in one line.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        check_values(given)
    except UserError as error:
        raise SystemExit(_report_failure(f"error: {error}", 2)) from None
    return given


def check_values(arguments: Sequence[str]) -> None:
    """Refuses empty values, which a shell makes of a variable that is not set.

    Raises:
        UserError: names the option.
    """
    option = "an argument"
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name.startswith("--"):
            option = name
        if not (value if equals and name == option else argument).strip():
            raise UserError(f"{option} is empty: give it a value, or leave it out")


def parse(kind: type[T], module: str, arguments: Sequence[str], **options: Any) -> T:
    """The options of a command line; exits after --help, and with 2 where they are wrong.

    Args:
        kind: dataclass of the options.
        module: of the program, for usage lines.
        arguments: of the command line.
        options: of `tyro.cli`.
    """
    import tyro  # noqa: PLC0415  (`leapjax --help` needs no extra)

    return tyro.cli(kind, prog=startup.format_command(module), args=list(arguments), **options)


# A path that is too long, leads through a file, into a folder that may not be looked into, or into
# one that was removed, such as the working folder.
NAMED_WRONGLY = {errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.ENOENT}


def run_program(module: str, arguments: Sequence[str], work: Callable[[], object]) -> int:
    """Does the work of a program; the exit code.

    Args:
        module: of the program.
        arguments: what it was given: an interrupted program says how to continue.
        work: all that it does.
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
    """Returns what an error says, and the options that would have to change."""
    options = [f"--{name.replace('_', '-')}" for name in getattr(error, "fields", ())]
    return f"{error} ({', '.join(options)})" if options else str(error)


def run_interruptible_program(
    module: str, arguments: Sequence[str], work: Callable[[Interruption], object]
) -> int:
    """The same for long work, which SIGINT and SIGTERM stop where nothing is lost."""

    def give_up(stopped: Interrupted) -> None:
        if not jax.distributed.is_initialized():  # the others would wait for this one
            stop(module, arguments, stopped)

    def interrupted_or_done() -> None:
        with catch_signals(give_up) as interruption:
            work(interruption)

    return run_program(module, arguments, interrupted_or_done)


def stop(module: str, arguments: Sequence[str], stopped: Interrupted) -> NoReturn:
    """Ends an interrupted program, and says how to continue it."""
    command = " ".join([startup.format_command(module), *map(shlex.quote, arguments)])
    print(f"stopped by {stopped}; continue with: {command}", file=sys.stderr)
    # At once: threads that still compile or write would crash in the interpreter's own end.
    jax_setup.exit_at_once(stopped.exit_code)


def _report_failure(message: str, code: int) -> int:
    print(message, file=sys.stderr)
    return jax_setup.leave_program(code)
