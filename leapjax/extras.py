"""Names the extra of the package that installs an optional module."""

import contextlib
from collections.abc import Iterator

from leapjax.errors import UserError

# For each top-level module, the smallest extra in pyproject.toml that installs it.
EXTRAS = {
    "optax": "train",
    "orbax": "train",
    "tensorstore": "train",
    "gymnasium": "train",
    "minari": "train",
    "h5py": "train",
    "PIL": "train",
    "tyro": "train",
    "rich": "train",
    "matplotlib": "train",
    "minigrid": "babyai",
    "ale_py": "atari",
    "tensorboardX": "tensorboard",
    "wandb": "wandb",
}
WITH_TRAIN = ("babyai", "atari")  # extras that include all of `train`


def explain_missing(error: BaseException | None, extra: str = "train") -> str | None:
    """Names the extra that installs a module that could not be imported.

    Args:
        error: error of the import.
        extra: extra that the importing program needs. The line names it instead of `train` if it
            includes all of `train`, so that one command installs everything.

    Returns:
        One line, or `None` if the error is of another kind or no extra installs the module.
    """
    if not isinstance(error, ModuleNotFoundError):
        return None
    brings = EXTRAS.get((error.name or "").partition(".")[0])
    if brings is None:
        return None
    if brings == "train" and extra in WITH_TRAIN:
        brings = extra
    return f'{error.name} is not installed: pip install ".[{brings}]" in a checkout of leapjax'


@contextlib.contextmanager
def report_missing(extra: str = "train") -> Iterator[None]:
    """Turns the failed import of an optional module into a UserError; other errors pass.

    Args:
        extra: see `explain_missing`.

    Raises:
        UserError: names the extra to install.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        explanation = explain_missing(error, extra)
        if explanation is None:
            raise
        raise UserError(explanation) from None
