"""Progress of long work: a live bar on a terminal, plain lines in a log."""

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LOG_INTERVAL = 10.0  # seconds between lines without a terminal


class Meter:
    """Shows the progress of some work, its speed and the time left.

    Args:
        console: console to print on.
        title: name of the work.
        total: amount of all work, in steps or other units.
        done: amount that was done before.
    """

    def __init__(self, console: Console, title: str, total: int, done: int = 0) -> None:
        self._console, self._title, self._total = console, title, total
        self._begun = self._shown = time.monotonic()
        self._first = done
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[note]}"),
                TimeRemainingColumn(),
                console=console,
            )
            self._task = self._bar.add_task(title, total=total, completed=done, note="")

    def __enter__(self) -> Self:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._bar:
            self._bar.stop()

    def update(self, done: int, note: str = "") -> None:
        """Shows that `done` of the total is done, with a note such as the loss."""
        now = time.monotonic()
        rate = (done - self._first) / max(now - self._begun, 1e-9)
        if self._bar:
            self._bar.update(self._task, completed=done, note=f"{format_speed(rate)} {note}")
            return
        if now - self._shown < LOG_INTERVAL and done != self._total:
            return
        self._shown = now
        left = f"{(self._total - done) / rate:.0f}s" if rate else "unknown"
        self._console.print(
            f"{self._title} {done}/{self._total}  {format_speed(rate)}  ETA {left}  {note}",
            highlight=False,
        )


def format_speed(rate: float) -> str:
    """Formats a rate per second; below 1, as seconds for each."""
    return f"{rate:.1f}/s" if rate >= 1 or rate == 0 else f"{1 / rate:.1f}s each"
