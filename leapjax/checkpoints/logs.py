"""Filters the messages that Orbax logs."""

import functools
import logging
import traceback
from pathlib import Path

import orbax.checkpoint as ocp

ORBAX = Path(ocp.__file__).parent


@functools.cache
def hush_orbax() -> None:
    """Drops the warnings of Orbax, whose failures this package reports in one line.

    On a full disk or a damaged checkpoint many threads of Orbax fail at once, and each logs its
    traceback.
    """
    for name in ("absl", "asyncio"):
        logging.getLogger(name).addFilter(lambda record: not _comes_from_orbax(record))


def _comes_from_orbax(record: logging.LogRecord) -> bool:
    """Returns whether Orbax logged a warning, or an exception in Orbax is its cause."""
    if record.levelno < logging.WARNING:
        return False
    failure = record.exc_info[2] if record.exc_info else None
    places = [record.pathname, *(frame.filename for frame in traceback.extract_tb(failure))]
    return any(Path(place).is_relative_to(ORBAX) for place in places)
