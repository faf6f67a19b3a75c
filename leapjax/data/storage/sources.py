"""Finds the source of a domain's demonstrations, which makes missing demonstrations."""

from collections.abc import Callable

from leapjax.data.storage.datasets import check_writable, has_dataset, name_dataset
from leapjax.data.storage.reading import describe_dropped, load
from leapjax.data.storage.writing import save
from leapjax.domain import Collection, Domain, Source
from leapjax.errors import UserError


def find_source(domain: Domain, count: int, seed: int) -> Source:
    """Returns the source of a domain's demonstrations.

    This is the domain's own source, if it has one. Otherwise its demonstrator makes the
    demonstrations once, and a Minari data set stores them.

    Args:
        domain: the level.
        count: number of demonstrations; the domain's own source ignores it.
        seed: training seed.
    """
    if domain.demonstrations.source is not None:
        return domain.demonstrations.source
    collect = domain.demonstrations.collect

    def make(name: str, progress: Callable[[int], None]) -> str:
        check_writable()
        if collect is None:
            raise UserError(explain_no_demonstrator(domain))
        collection = collect(count, seed, progress)
        dropped = describe_dropped(collection)
        summary = f"{count} demonstrations of {domain.level}"
        summary += f"; dropped: {dropped}" if dropped else ""
        save(name, collection, domain, summary)
        return summary

    def load_all(name: str, seed: int) -> Collection:
        del seed
        loaded = load(name, domain, count)
        found, dropped = len(loaded.demonstrations), describe_dropped(loaded)
        if found < count:
            also = f" that can be used ({dropped})" if dropped else ""
            raise UserError(
                f"{name} has {found} episodes{also}, fewer than {count}: ask for {found}",
                "demos",
            )
        return loaded

    default = name_dataset(domain, count, seed)
    return Source(default, has_dataset, make, load_all, count, "demonstrations")


def explain_no_demonstrator(domain: Domain) -> str:
    """Returns the message for a domain that has no demonstrator."""
    return f"{domain.level} has no demonstrator: name a Minari data set of it to train on"
