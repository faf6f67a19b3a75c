"""The extras of the package: which of them brings an optional module, and how to install it."""

import contextlib
from collections.abc import Iterator

from leapjax.errors import UserError

# By top-level module, the smallest extra of pyproject.toml that brings it.
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
WITH_TRAIN = ("babyai", "atari")  # extras that bring all of `train`, too


def explain_missing(error: BaseException | None, extra: str = "train") -> str | None:
    """Says which extra brings the module that could not be imported.

    Args:
        error: of the import.
        extra: that the importing program needs. It is named instead of `train` if it brings all of
            `train`, so that one command installs everything.

    Returns:
        One line, or None if the error is another one, or the module belongs to no extra.
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
    """Turns the failing import of an optional module into one line; other errors pass.

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
