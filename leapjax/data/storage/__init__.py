"""Demonstrations as Minari data sets: one path writes them, one path reads them.

A user's own data set of the same observations is read in the same way. `datasets` names and finds
data sets, `writing` and `reading` convert them to and from demonstrations, `inspection` protects
from data of unknown origin, `episodes` checks each episode against its domain, `provenance` the
environment of the data, and `sources` makes what does not exist yet.
"""

from leapjax.data.storage.datasets import (
    UNKNOWN_SEED,
    dataset_id,
    datasets_folder,
    described,
    exists,
)
from leapjax.data.storage.episodes import check_demonstration
from leapjax.data.storage.reading import load, reasons
from leapjax.data.storage.sources import find_source, no_demonstrator
from leapjax.data.storage.spaces import observation_space
from leapjax.data.storage.writing import save
from leapjax.domain import Described

__all__ = [
    "UNKNOWN_SEED",
    "Described",
    "check_demonstration",
    "dataset_id",
    "datasets_folder",
    "described",
    "exists",
    "find_source",
    "load",
    "no_demonstrator",
    "observation_space",
    "reasons",
    "save",
]
