"""Where measurements go while a run is under way, beside its own CSV files.

Nothing leaves the machine: Weights & Biases is offline unless WANDB_MODE says otherwise.
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
    """What every kind of logger does."""

    log: Log
    close: Callable[[], None]


class About(NamedTuple):
    """What a logger may want to know of a run."""

    folder: Path
    name: str  # of its configuration: a run that goes on has the same
    configuration: Mapping[str, Any]
    begin: int  # training steps that were done, and logged, before


def log_nothing(step: int, values: Mapping[str, float]) -> None:
    """Logs nothing."""


def open_tensorboard(about: About) -> Logger:
    """Event files in the run's folder."""
    writer = _import_logger("tensorboard").SummaryWriter(
        str(about.folder / "tensorboard"), purge_step=about.begin + 1 if about.begin else None
    )

    def log(step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, step)

    return Logger(log, writer.close)


def open_wandb(about: About) -> Logger:
    """A run of Weights & Biases, in the run's folder."""
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
    """Refuses loggers that there are not, or that are not installed.

    Raises:
        UserError: says which, and what to do.
    """
    for name in names:
        if name not in LOGGERS:
            raise UserError(f"unknown logger {name!r}: expected some of {', '.join(LOGGERS)}")
        _import_logger(name)


def _import_logger(name: str) -> ModuleType:
    """The module that a logger needs."""
    with report_missing():
        return importlib.import_module(_MODULES[name])


@contextlib.contextmanager
def open_loggers(names: Sequence[str], about: Callable[[], About]) -> Iterator[Log]:
    """Inside, what is given to the function goes to some loggers; they begin with the first."""
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
