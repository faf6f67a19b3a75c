"""Stops a program on SIGINT and SIGTERM after its work is saved."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
GRACE = 1.0  # seconds within which a signal should have its effect


class Interrupted(BaseException):
    """A signal asked the program to stop.

    This is not an `Exception`, so that `except Exception` does not catch it.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        # The caller of the program sees Ctrl-C as a failure, and SIGTERM as a normal end.
        self.exit_code = 130 if number == signal.SIGINT else 0


class Interruption:
    """Receives the two signals while a program runs: see `catch_signals`."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._deferred = False

    def handle(self, number: int, _: FrameType | None = None) -> None:
        """Handles a signal. A second signal is not deferred."""
        waits = self._deferred and self._number is None
        self._number = number
        if not waits:
            raise Interrupted(number)

    @property
    def waits(self) -> bool:
        """Whether signals are deferred."""
        return self._deferred

    @property
    def requested(self) -> int | None:
        """The number of the signal that arrived, or `None`."""
        return self._number

    def adopt(self, number: int) -> None:
        """Takes over a signal that another process of this run received."""
        self._number = self._number or number

    def check(self) -> None:
        """Raises `Interrupted` if a signal arrived.

        Python may have dropped the exception that `handle` raised in a callback.
        """
        if self._number is not None:
            raise Interrupted(self._number)

    @contextlib.contextmanager
    def defer_signals(self) -> Iterator[None]:
        """Defers signals inside the block, where `requested` shows them; its end raises them."""
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
    """Lets SIGINT and SIGTERM raise `Interrupted` inside the block, unless they are deferred.

    Python cannot raise while a compiler runs, and drops exceptions in some callbacks.

    Args:
        give_up: ends the program; another thread calls it if a signal that is not deferred had
            no effect for a second.
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
