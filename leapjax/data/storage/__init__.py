"""Demonstrations as Minari data sets: one path writes them, one path reads them.

A user's own data set of the same observations is read in the same way. `datasets` names and finds
data sets, `writing` and `reading` convert them to and from demonstrations, `inspection` protects
from data of unknown origin, `episodes` checks each episode against its domain, `provenance` the
environment of the data, and `sources` makes what does not exist yet.
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
