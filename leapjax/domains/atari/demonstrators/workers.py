"""Processes that play games in parallel."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from leapjax.errors import UserError


@contextlib.contextmanager
def start_workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Starts processes to play in, and ends them at once after use.

    Raises:
        UserError: a process died.
    """
    others = set(multiprocessing.active_children())
    # Spawned, not forked: this process may run threads.
    pool = ProcessPoolExecutor(
        count, multiprocessing.get_context("spawn"), initializer=_end_with_parent
    )
    try:
        yield pool
    except BrokenProcessPool:
        raise UserError(
            "a process that played games has ended, perhaps for want of memory: start it "
            "again, perhaps with fewer workers, and it goes on"
        ) from None
    finally:
        # Do not wait for unfinished files: without their manifests they are made again.
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)


def is_finished(made: Future[Any]) -> bool:
    """Returns whether a process has finished its file; raises the process's exception."""
    if not made.done():
        return False
    made.result()
    return True


def _end_with_parent() -> None:
    """Makes a process ignore Ctrl-C, and end when the process that started it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    first = multiprocessing.parent_process()

    def follow() -> None:
        if first is not None:
            first.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
