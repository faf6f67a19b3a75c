"""Stores demonstrations as Minari data sets: `save` writes them, `load` reads them.

`load` also reads a user's own data sets of the same observations. The modules:

- `datasets` names and finds data sets, and `spaces` describes their observations.
- `writing` and `reading` convert demonstrations to data sets and back.
- `inspection` protects from data of unknown origin.
- `episodes` checks each episode against its domain.
- `provenance` compares the environment of the data with the level.
- `sources` makes missing data sets.
"""

from leapjax.data.storage.datasets import (
    UNKNOWN_SEED,
    describe_dataset,
    find_datasets_folder,
    has_dataset,
    name_dataset,
)
from leapjax.data.storage.episodes import check_demonstration
from leapjax.data.storage.reading import describe_dropped, load
from leapjax.data.storage.sources import explain_no_demonstrator, find_source
from leapjax.data.storage.spaces import make_observation_space
from leapjax.data.storage.writing import save
from leapjax.domain import Described

__all__ = [
    "UNKNOWN_SEED",
    "Described",
    "check_demonstration",
    "describe_dataset",
    "describe_dropped",
    "explain_no_demonstrator",
    "find_datasets_folder",
    "find_source",
    "has_dataset",
    "load",
    "make_observation_space",
    "name_dataset",
    "save",
]
