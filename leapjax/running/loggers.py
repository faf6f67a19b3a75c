"""Sends measurements of a run to TensorBoard and Weights & Biases, beside its CSV files.

Weights & Biases stays offline unless WANDB_MODE says otherwise.
"""

import contextlib
import importlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from leapjax.errors import UserError
from leapjax.extras import report_missing

Log = Callable[[int, Mapping[str, float]], None]  # (training step, values by name)


class Logger(NamedTuple):
    """The functions of an open logger.

    Attributes:
        log: (training step, values by name); logs measurements.
        close: closes the logger.
    """

    log: Log
    close: Callable[[], None]


class About(NamedTuple):
    """Description of a run for its loggers.

    Attributes:
        folder: folder of the run.
        name: hash of its configuration, by which a resumed run finds its log.
        configuration: settings of the run, as JSON values.
        begin: number of training steps that were done and logged before.
    """

    folder: Path
    name: str
    configuration: Mapping[str, Any]
    begin: int


def log_nothing(step: int, values: Mapping[str, float]) -> None:
    """Ignores measurements."""


def open_tensorboard(about: About) -> Logger:
    """Opens event files in the run's folder."""
    writer = _import_logger("tensorboard").SummaryWriter(
        str(about.folder / "tensorboard"), purge_step=about.begin + 1
    )

    def log(step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, step)

    return Logger(log, writer.close)


def open_wandb(about: About) -> Logger:
    """Opens a run of Weights & Biases in the run's folder."""
    run = _import_logger("wandb").init(
        project="leapjax", name=about.folder.name, id=about.name, resume="allow",
        dir=str(about.folder), config=dict(about.configuration),
        mode=os.environ.get("WANDB_MODE", "offline"),
    )  # fmt: skip

    def log(step: int, values: Mapping[str, float]) -> None:
        run.log(dict(values), step=step)

    return Logger(log, run.finish)


LOGGERS: Mapping[str, Callable[[About], Logger]] = {
    "tensorboard": open_tensorboard,
    "wandb": open_wandb,
}
_MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb"}


def check(names: Sequence[str]) -> None:
    """Checks that loggers exist and are installed.

    Raises:
        UserError: names the logger, and the remedy.
    """
    for name in names:
        if name not in LOGGERS:
            raise UserError(f"unknown logger {name!r}: expected some of {', '.join(LOGGERS)}")
        _import_logger(name)


def _import_logger(name: str) -> ModuleType:
    """Imports the module of a logger."""
    with report_missing():
        return importlib.import_module(_MODULES[name])


@contextlib.contextmanager
def open_loggers(names: Sequence[str], about: Callable[[], About]) -> Iterator[Log]:
    """Yields a function that logs to some loggers; its first call opens them."""
    if not names:
        yield log_nothing
        return
    with contextlib.ExitStack() as stack:
        begun: list[Logger] = []

        def log(step: int, values: Mapping[str, float]) -> None:
            if not begun:
                run = about()
                for name in names:
                    begun.append(LOGGERS[name](run))
                    stack.callback(begun[-1].close)
            for logger in begun:
                logger.log(step, values)

        yield log
