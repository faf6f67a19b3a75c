"""SIGINT and SIGTERM: stop where nothing is lost, and say how to go on."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
GRACE = 1.0  # seconds in which a signal should have its effect


class Interrupted(BaseException):
    """The program was asked to stop. Not an `Exception`: nothing on the way may catch it."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        # Ctrl-C is a failure to whoever waits for the command; a polite SIGTERM is not.
        self.exit_code = 130 if number == signal.SIGINT else 0


class Interruption:
    """What the two signals do while a program runs: see `catch_signals`."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._deferred = False

    def handle(self, number: int, _: FrameType | None = None) -> None:
        """The signal handler. A second signal does not wait any more."""
        waits = self._deferred and self._number is None
        self._number = number
        if not waits:
            raise Interrupted(number)

    @property
    def waits(self) -> bool:
        """Whether a signal waits until something is done."""
        return self._deferred

    @property
    def requested(self) -> int | None:
        """The signal that came, if one came."""
        return self._number

    def adopt(self, number: int) -> None:
        """A signal that came to another process of this run."""
        self._number = self._number or number

    def check(self) -> None:
        """Raises what came. Python may have dropped it: it can do so inside a callback."""
        if self._number is not None:
            raise Interrupted(self._number)

    @contextlib.contextmanager
    def defer_signals(self) -> Iterator[None]:
        """Inside, a signal waits: look at `requested`. At the end it is raised."""
        self.check()
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False
        self.check()


@contextlib.contextmanager
def catch_signals(
    give_up: Callable[[Interrupted], object] = lambda stopped: None,
) -> Iterator[Interruption]:
    """Inside, SIGINT and SIGTERM raise `Interrupted`, at once or where they were deferred.

    Python raises nothing while a compiler runs, and drops what is raised in some callbacks.

    Args:
        give_up: called from another thread where a signal that does not wait had no effect for
            a second; it ends the program.
    """
    interruption = Interruption()
    try:
        before = {number: signal.signal(number, interruption.handle) for number in SIGNALS}
    except ValueError:  # not the main thread: signals do not arrive here
        yield interruption
        return
    heard, told = os.pipe()
    os.set_blocking(told, False)
    signal.set_wakeup_fd(told)

    def watch() -> None:
        while byte := os.read(heard, 1):
            if byte[0] in SIGNALS and not over.wait(GRACE) and not interruption.waits:
                give_up(Interrupted(byte[0]))

    over = threading.Event()
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield interruption
    finally:
        over.set()
        signal.set_wakeup_fd(-1)
        os.close(told)
        watcher.join()
        os.close(heard)
        for number, handler in before.items():
            signal.signal(number, handler)
