"""Level seeds: disjoint ranges for training, validation and test, in one place."""

from collections.abc import Iterator

from leapjax.checks import check_integer
from leapjax.errors import UserError

# Test levels come first, so that `--test-seed 1000` names a test level. Development of the methods
# used the first thousands; results are measured from `UNSEEN` on.
UNSEEN = 10_000_000
VALIDATION_START = 100_000_000
TRAINING_START = 200_000_000
TRAINING_STRIDE = 1_000_000  # level seeds per training seed
MAX_TRAINING_SEED = 1_000


def test_seeds(first: int, episodes: int) -> range:
    """Returns the level seeds of the test episodes, equal for every method and training seed.

    Raises:
        UserError: there are no episodes, or the seeds reach those for validation or training.
    """
    return _make_range(first, episodes, 0, VALIDATION_START, "test")


def validation_seeds(first: int, episodes: int) -> range:
    """Returns level seeds of the validation episodes, on which settings are chosen."""
    return _make_range(first, episodes, VALIDATION_START, TRAINING_START, "validation")


def training_seeds(seed: int) -> Iterator[int]:
    """Returns the level seeds for the demonstrations of one training seed.

    Raises:
        UserError: the training seed is out of range; or, after the last level seed, there are no
            more.
    """
    seed = check_integer("a training seed", seed, 0, MAX_TRAINING_SEED - 1)
    start = TRAINING_START + seed * TRAINING_STRIDE

    def count_up() -> Iterator[int]:
        yield from range(start, start + TRAINING_STRIDE)
        raise UserError(f"training seed {seed} has no more level seeds than {TRAINING_STRIDE}")

    return count_up()


def check_disjoint(demonstrations: list[int], episodes: range) -> None:
    """Checks that no demonstration comes from a level of the evaluation.

    Raises:
        UserError: a level seed is in both.
    """
    shared = [seed for seed in demonstrations if seed in episodes]
    if shared:
        raise UserError(
            f"level seed {shared[0]} is both a demonstration and a test episode: "
            "choose another first seed of the tests",
            "test_seed",
        )


def _make_range(first: int, episodes: int, low: int, high: int, kind: str) -> range:
    """Returns `episodes` level seeds, from `low + first` on.

    Raises:
        UserError: a number is not an integer, there are no episodes, or the seeds reach `high`.
    """
    episodes = check_integer(f"the number of {kind} episodes", episodes, 1)
    first = check_integer(f"the first {kind} seed", first, 0, high - low - 1)
    if first + episodes > high - low:
        raise UserError(
            f"{kind} seeds {first} .. {first + episodes - 1} leave their range "
            f"0 .. {high - low - 1}; the seeds beyond it belong to other episodes"
        )
    return range(low + first, low + first + episodes)
